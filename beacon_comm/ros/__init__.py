"""The ROS 2 node: messages in, one call of the core, messages out.  The only room that needs rclpy.

``node`` starts and ends it, ``beacon_node`` is the node; what they do is in the modules beside them, most of which
know no ROS (``clock_map``, ``stream_time``, ``live``, ``text``, ``silence``).
"""
