"""What carries a whole environment: local, rosbridge (bam_msgs/GymAPI), TCP, native ROS 2."""
