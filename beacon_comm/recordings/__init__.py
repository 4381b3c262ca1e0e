"""Recordings: bags, MATLAB event files, merged scenes and their truth.  No ROS installation is needed."""
