"""Robot profiles: which topics a live robot has. The shipped ones are the TOML files of this folder."""

from bam_envs.robots.profiles.profile import load_profile, profile_for, shipped_profiles
from bam_envs.ros.profile_tables import CameraSource, RobotProfile, Sink, Source

__all__ = ["CameraSource", "RobotProfile", "Sink", "Source", "load_profile", "profile_for", "shipped_profiles"]
