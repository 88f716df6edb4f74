"""Names that other packages have for these environments: BAM's and robo-gym's ids; importing this is cheap."""
