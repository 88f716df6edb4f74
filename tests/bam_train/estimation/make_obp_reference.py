"""Write obp_reference.json: synthetic bandit data of obp 0.4.1 and its estimates; needs `pip install obp==0.4.1`."""

import json
from pathlib import Path

import numpy as np
from obp.dataset import SyntheticBanditDataset, linear_behavior_policy, logistic_reward_function
from obp.ope import DirectMethod, DoublyRobust, InverseProbabilityWeighting, SelfNormalizedInverseProbabilityWeighting

ROUNDS, ACTIONS = 120, 3


def main():
    dataset = SyntheticBanditDataset(
        n_actions=ACTIONS,
        dim_context=4,
        reward_function=logistic_reward_function,
        behavior_policy_function=linear_behavior_policy,
        random_state=12345,
    )
    feedback = dataset.obtain_batch_bandit_feedback(n_rounds=ROUNDS)
    rng = np.random.default_rng(0)
    policy = rng.dirichlet(np.ones(ACTIONS), ROUNDS).round(6)
    policy[:, -1] = 1 - policy[:, :-1].sum(axis=1)
    model = np.clip(feedback["expected_reward"] + 0.1 * rng.standard_normal((ROUNDS, ACTIONS)), 0, 1).round(6)
    pscore = feedback["pscore"].round(6)
    taken = {"reward": feedback["reward"], "action": feedback["action"], "position": np.zeros(ROUNDS, int)}
    weighted = {**taken, "pscore": pscore, "action_dist": policy[:, :, None]}
    modelled = {"estimated_rewards_by_reg_model": model[:, :, None]}
    reference = {
        "reward": taken["reward"].tolist(),
        "action": taken["action"].tolist(),
        "pscore": pscore.tolist(),
        "policy": policy.tolist(),
        "model": model.tolist(),
        "ips": InverseProbabilityWeighting().estimate_policy_value(**weighted),
        "snips": SelfNormalizedInverseProbabilityWeighting().estimate_policy_value(**weighted),
        "dm": DirectMethod().estimate_policy_value(
            action_dist=policy[:, :, None], position=taken["position"], **modelled
        ),
        "dr": DoublyRobust().estimate_policy_value(**weighted, **modelled),
    }
    Path(__file__).with_name("obp_reference.json").write_text(json.dumps(reference) + "\n")


if __name__ == "__main__":
    main()
