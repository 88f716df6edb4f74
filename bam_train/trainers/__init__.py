"""Training: one protocol, `Trainer`, and its implementations by library, which are imported on use."""

from bam_train.trainers.algorithms import TRAINERS, load_trainer, require_algorithm

__all__ = ["TRAINERS", "load_trainer", "require_algorithm"]
