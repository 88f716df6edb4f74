"""Episodes of a policy over a fixed list of starts: success, return and length; and the detector made from them."""

from bam_train.evaluation.evaluation import (
    FIRST_SEED,
    Z95,
    EvaluationReport,
    default_num_envs,
    evaluate,
    record_video,
    success_text,
    summarise,
    waves,
    wilson_interval,
)

__all__ = [
    "FIRST_SEED",
    "Z95",
    "EvaluationReport",
    "default_num_envs",
    "evaluate",
    "record_video",
    "success_text",
    "summarise",
    "waves",
    "wilson_interval",
]
