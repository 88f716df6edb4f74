"""The torch layer of the loop: the only place in it that imports torch when it is imported."""
