"""What only programs written for BBRL need; they import it from `bam_train.loop`."""
