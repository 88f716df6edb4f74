"""The front process of a live agent: its port, its console, and everything else that listens."""
