"""Run the policy of a checkpoint on a MiR100, and say how each episode went.

The checkpoint is a checkpoint.zip, or a directory that RLlib wrote: of a whole algorithm or of one policy, by its
present API or by the old one. Only the policy is read: no Ray is started, no worker, and no environment but this one.

Examples:
  python scripts/policy_from_cp_mir.py checkpoints/mir100-navigation-rllib-ppo.zip
  python scripts/policy_from_cp_mir.py ray_results/run/checkpoint_000024 --trust-pickle --seed 7
  python scripts/policy_from_cp_mir.py checkpoint_000024/policies/default_policy --env NoObstacleNavigationMir100Sim-v0
  python scripts/policy_from_cp_mir.py checkpoints/mir100-navigation-rllib-ppo.zip --robot ws://10.0.0.5:9090
"""

from policy_from_cp import main

if __name__ == "__main__":
    raise SystemExit(main(__file__, __doc__, "bam/mir100-navigation-v0", "mir"))
