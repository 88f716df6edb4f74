"""Compatibility with programs written for BBRL, which import these names from `bam_train.loop`."""
