"""The control law: pure functions of numbers, no ROS, no files, no clock."""
