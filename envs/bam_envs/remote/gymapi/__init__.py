"""bam_msgs/GymAPI: requests, responses, and spaces in its fields; pure functions."""
