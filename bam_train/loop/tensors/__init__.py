"""The torch layer of the loop: its only package that imports torch when it is imported."""
