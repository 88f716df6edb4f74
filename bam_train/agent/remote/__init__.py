"""A live agent elsewhere: the protocol of its socket, and the client of programs."""
