"""The pure core: events in, tracks, characters and bearings out.  No ROS, no printing, no wall clock."""
