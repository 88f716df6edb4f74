"""The rosbridge v2 protocol: a sans-I/O core, the server that speaks it, the link of a client, and what both share."""
