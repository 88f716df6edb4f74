"""Train a UR5 to bring its flange to a point with RLlib, save checkpoint.zip, and use it in a new environment.

Training ends at the first of --stop-iters, --stop-timesteps and --stop-reward. The checkpoint is saved after every
iteration, so whatever ends the program leaves the last one, and bam-train --resume goes on from it; Ctrl-C and SIGTERM
wait for the end of an iteration. RLLIB_NUM_GPUS=1 learns on a GPU. An iteration of PPO, which is tuned for this, has
4,096 steps; the others have RLlib's own settings: in one process 200 of SAC, 50 of APPO and IMPALA.

Examples:
  python scripts/training_inference_ur.py                                     PPO, in this process
  python scripts/training_inference_ur.py --num-cpus 3 --stop-reward 1.9      two other processes run the episodes
  python scripts/training_inference_ur.py --run SAC --stop-iters 50 --seed 1  another algorithm
  python scripts/training_inference_ur.py --env EndEffectorPositioningURSim-v0 --parity --render
  python scripts/training_inference_ur.py --robot ws://10.0.0.5:9090          train here, then move a real UR5
"""

from training_inference import Experiment, main

EXPERIMENT = Experiment(
    "bam/ur-reach-v0", stop_reward=1.88, stop_timesteps=1_500_000, stop_iters=400, env_kwargs={"ur_model": "ur5"}
)

if __name__ == "__main__":
    raise SystemExit(main(__file__, __doc__, EXPERIMENT))
