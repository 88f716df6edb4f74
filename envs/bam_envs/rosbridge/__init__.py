"""The rosbridge v2 protocol: a sans-I/O core, a server around it, the link of a client, and their common parts."""
