"""`bam-robots`."""
