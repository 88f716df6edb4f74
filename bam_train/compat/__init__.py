"""What only programs written for BBRL or RLlib need."""
