"""How good is a policy: estimates from recorded episodes, and the release gate that compares two policies."""
