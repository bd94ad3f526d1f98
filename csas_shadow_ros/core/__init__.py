"""The method itself: NumPy in, NumPy out, no ROS import anywhere below this package."""
