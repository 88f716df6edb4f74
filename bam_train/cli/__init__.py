"""The programs; one small module each."""
