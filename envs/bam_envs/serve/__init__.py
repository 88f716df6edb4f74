"""The other end of robots and transports: an environment and its simulated robot, served to many clients."""
