"""What serves an environment, and its simulated robot, to many clients."""
