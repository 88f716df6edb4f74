"""Train a MiR100 to drive to a place with RLlib, save checkpoint.zip, and use it in a new environment.

Training ends at the first of --stop-iters, --stop-timesteps and --stop-reward. The checkpoint is saved after every
iteration, so whatever ends the program leaves the last one, and bam-train --resume goes on from it; Ctrl-C and SIGTERM
wait for the end of an iteration. RLLIB_NUM_GPUS=1 learns on a GPU. An iteration of PPO, which is tuned for this, has
4,096 steps; the others have RLlib's own settings: in one process 200 of SAC, 50 of APPO and IMPALA.

Examples:
  python scripts/training_inference_mir.py                                     PPO, in this process
  python scripts/training_inference_mir.py --num-cpus 3 --stop-reward 2.5      two other processes run the episodes
  python scripts/training_inference_mir.py --run SAC --stop-iters 50 --seed 1  another algorithm
  python scripts/training_inference_mir.py --env NoObstacleNavigationMir100Sim-v0 --parity --render
  python scripts/training_inference_mir.py --robot ws://10.0.0.5:9090          train here, then drive a real MiR100
"""

from training_inference import Experiment, main

EXPERIMENT = Experiment("bam/mir100-navigation-v0", stop_reward=2.4, stop_timesteps=200_000, stop_iters=200)

if __name__ == "__main__":
    raise SystemExit(main(__file__, __doc__, EXPERIMENT))
