"""Recordings: what a deployment measured, decided and sent, in one MCAP file of which a crash costs the last tick."""
