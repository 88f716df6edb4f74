"""Programs for a live robot besides bam-deploy."""
