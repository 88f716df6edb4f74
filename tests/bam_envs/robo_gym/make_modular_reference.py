"""Write modular_reference.npz: episodes of robo-gym 2.1.0's modular environments, step by step.

robo-gym 2.1.0 is in no package index. With its sources in SOURCES, where robo-gym's requirements are installed (as in
build/peers/robo_gym): PYTHONPATH=SOURCES python -m tests.bam_envs.robo_gym.make_modular_reference

Ours makes the states, theirs sees them, as in `test_parity.py`; what is kept are the options and actions of each
episode, and theirs answers.
"""

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np

import bam_envs  # noqa: F401 - registers the ids

PATH = Path(__file__).with_name("modular_reference.npz")
CLASSES = {"IsaacReachUR": "robo_gym.envs.ur.ur_isaac_reach", "EndEffectorPositioning2UR": "robo_gym.envs.ur.ur_ee_pos"}
HOLD = "hold"
"""Instead of an action: the one whose joint targets are where the arm is."""
RUNS = {
    "isaac random": ("IsaacReachUR", {}, [({}, ("random", 0.4), 40), ({}, ("random", 2.0), 40)]),
    "isaac pose given": (
        "IsaacReachUR",
        {},
        [({"ee_target_pose": [0.5, 0.1, 0.3, 0.2, 1.4, -0.5]}, ("random", 1.0), 20)],
    ),
    "isaac ur5e, scale 1": ("IsaacReachUR", {"ur_model": "ur5e", "isaac_scale": 1.0}, [({}, ("random", 0.5), 30)]),
    "isaac arrives, goes on, collides, begins anew": (
        "IsaacReachUR",
        {},
        [
            ({"ee_target_pose": "goal"}, [0.4, 0.6, -0.5, 0.3, 0.5, 0.4], 60),
            ({}, ("random", 0.2), 10),
            ({}, [0.0, 5.0, 0.0, 0.0, 0.0, 0.0], 200),
            ({}, ("random", 0.2), 5),
        ],
    ),
    "isaac stays, and goes on there": ("IsaacReachUR", {}, [({}, [0.2] * 6, 600), ({}, ("random", 0.2), 5)]),
    "isaac does not go on": (
        "IsaacReachUR",
        {"continue_except_collision": False},
        [({"ee_target_pose": "goal"}, [0.4, 0.6, -0.5, 0.3, 0.5, 0.4], 60), ({}, ("random", 0.2), 5)],
    ),
    "positioning random": (
        "EndEffectorPositioning2UR",
        {},
        [({}, ("random", 0.05), 40), ({"ee_target_pose": [0.3, -0.4, 0.5, 0, 0, 0]}, ("random", 1.0), 30)],
    ),
    "positioning of all joints": ("EndEffectorPositioning2UR", {"fix_wrist_3": False}, [({}, ("random", 0.3), 20)]),
    "positioning of some joints": (
        "EndEffectorPositioning2UR",
        {"fix_base": True, "fix_wrist_1": True, "ur_model": "ur10e"},
        [({"joint_positions": [0.3, -1.9, 1.2, -0.2, -1.0, 0.4]}, ("random", 0.3), 20)],
    ),
    "positioning arrives, goes on, collides, begins anew": (
        "EndEffectorPositioning2UR",
        {"continue_on_success": True},
        [
            ({"ee_target_pose": "goal"}, [0.1, -0.3, 0.2, 0.1, -0.1], 60),
            ({}, ("random", 0.2), 5),
            ({}, [0.0, 0.3, 0.0, 0.0, 0.0], 200),
            ({}, ("random", 0.2), 5),
        ],
    ),
    "positioning stays": ("EndEffectorPositioning2UR", {}, [({"ee_target_pose": [0, -0.4, 0.6, 0, 0, 0]}, HOLD, 300)]),
}
"""Name to robo-gym's id, its arguments, and episodes: options, actions, most steps."""


class Client:
    """robo-gym's client of a robot server: `wire` is what comes back, `sent` what was last sent."""

    wire, sent = None, None

    def set_state_msg(self, message):
        self.sent = message
        return True

    def get_state_msg(self):
        return SimpleNamespace(state=[], state_dict=self.wire)

    def send_action_get_state(self, action):
        self.sent = action
        return self.get_state_msg()


def make_ours(stem, kwargs):
    return gym.make(f"{stem}Sim-v0", parity=True, disable_env_checker=True, **kwargs)


def main():
    kept = {}
    for name, (stem, kwargs, episodes) in RUNS.items():
        ours = make_ours(stem, kwargs)
        model = {"ur_model": "ur5"} if stem.startswith("End") else {}
        kind = getattr(import_module(CLASSES[stem]), f"{stem}Sim")
        theirs = kind(**{**model, **kwargs})
        theirs._client = client = Client()
        own_start = theirs._config["joint_position"]
        kept[f"{name}/low"], kept[f"{name}/high"] = theirs.observation_space.low, theirs.observation_space.high
        kept[f"{name}/action_low"], kept[f"{name}/action_high"] = theirs.action_space.low, theirs.action_space.high
        for number, (options, acts, most) in enumerate(episodes):
            rng, options = np.random.default_rng(number), dict(options)
            if options.get("ee_target_pose") == "goal":
                options["ee_target_pose"] = goal(stem, kwargs, acts)
            ours.reset(seed=1 if number == 0 else None, options=options)
            env = ours.unwrapped
            target = options.get("ee_target_pose")
            if target is None and stem == "IsaacReachUR":
                target = [*env.task.target[0].tolist(), *env.task.quaternion[0].tolist()]
                options["ee_target_pose"] = target
            theirs._config["ee_target_pose"] = target
            theirs._config["joint_position"] = options.get("joint_positions", own_start)
            client.wire = env.get_rs_state()
            rows = {"observation": [theirs.reset()[0]]}
            rows["start"] = [client.sent.state_dict[f"{one}_joint_position"] for one in JOINTS]
            for _ in range(most):
                action = np.asarray(choose(acts, env, theirs, rng), np.float32)
                ended = ours.step(action)[2]
                client.wire = env.get_rs_state()
                seen, reward, done, _, info = theirs.step(action)
                row = {"observation": seen, "action": action, "reward": reward, "sent": client.sent}
                row |= {"status": info.get("final_status", ""), "distance": info["dist_coord"]}
                row |= {"angle": info.get("dist_rot", np.nan)}
                for key, value in row.items():
                    rows.setdefault(key, []).append(value)
                assert ended == done, (name, number, ended, info)
                if done:
                    break
            print(name, number, len(rows["reward"]), rows["status"][-1])
            kept |= {f"{name}/{number}/{key}": np.array(values) for key, values in rows.items()}
            kept |= {f"{name}/{number}/options/{key}": np.array(value) for key, value in options.items()}
    np.savez_compressed(PATH, **kept)


JOINTS = ["base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3"]


def choose(acts, env, theirs, rng):
    """The next action."""
    joints = env.last_state.signals["joint_position"][0]
    if isinstance(acts, list):
        return acts
    here = env.task.action_to(joints[None])[0]
    if acts == HOLD:
        return here
    low, high = theirs.action_space.low, theirs.action_space.high
    return np.clip(here + rng.uniform(-acts[1], acts[1], len(here)), low, high)


def goal(stem, kwargs, action):
    """The pose that the flange has after some steps of an action; of positioning, without its orientation."""
    ours = make_ours(stem, kwargs)
    ours.reset(seed=1, options={"ee_target_pose": [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]})
    for _ in range(40):
        ours.step(np.asarray(action, np.float32))
    wire = ours.unwrapped.get_rs_state()
    place = [wire[f"ee_to_ref_translation_{axis}"] for axis in "xyz"]
    turned = [wire[f"ee_to_ref_rotation_{axis}"] for axis in "xyzw"]
    return place + (turned if stem == "IsaacReachUR" else [0.0, 0.0, 0.0])


if __name__ == "__main__":
    main()
