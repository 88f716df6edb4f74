"""What an environment says over a network, for both sides: its messages as JSON, ROS messages and frames of TCP."""
