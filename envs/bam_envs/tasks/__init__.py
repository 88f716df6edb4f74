"""Tasks: observation, command, reward, end and success; pure, one a file."""
