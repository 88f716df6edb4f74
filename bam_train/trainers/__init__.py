"""Training: one protocol, `Trainer`, and the libraries behind it, imported when they are used."""

from bam_train.trainers.algorithms import TRAINERS, load_trainer, require_algorithm

__all__ = ["TRAINERS", "load_trainer", "require_algorithm"]
