"""Live robots behind rosbridge, and the one function that builds them."""

from bam_envs.live.building import live_robot, profile_limits, shadow_robot

__all__ = ["live_robot", "profile_limits", "shadow_robot"]
