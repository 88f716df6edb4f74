"""Data sets: episodes in a folder of Parquet that LeRobot v3.0 opens, with every number of them bit for bit."""

from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.record_dataset import RecordDataset
from bam_train.data.recorded_episode import DataSetInfo, Episode, Transitions

__all__ = ["DataSet", "DataSetInfo", "DataSetWriter", "Episode", "RecordDataset", "Transitions"]
