"""The ROS 2 node. rclpy is imported inside functions: the rest of the package never needs it."""
