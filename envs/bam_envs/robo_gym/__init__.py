"""robo-gym's own names for our environments: its ids, its constructor options, its extra methods, its wire states."""
