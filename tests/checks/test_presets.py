"""`checks presets`: which presets it trains with, and the row of one."""

import pytest

from bam_envs.core.errors import InvalidValue
from tests.checks import presets
from tests.checks.commands import Result
from tests.checks.presets import Flags


def test_each_preset_that_needs_nothing_else_has_its_command():
    commands = {name: " ".join(words) for name, words in presets.presets().items()}
    assert commands["CartPole-v1-a2c"] == "bam-train --env CartPole-v1 --algo a2c"
    assert commands["grasp-xyr-grasp-q"] == "bam-train --env bam/grasp-xyr --algo grasp-q"
    assert commands["ur-reach-rllib-ppo"] == "bam-train --env bam/ur-reach --algo ppo --trainer rllib"
    assert not {"pick-dagger", "pick-offline-bc"} & set(commands)
    assert set(presets.ZOO) <= set(commands)


def test_a_row_takes_the_place_of_the_earlier_one_of_its_preset(tmp_path, monkeypatch):
    page, rates = tmp_path / "presets.md", iter([0.5, 1.0, 0.99, 0.98, 0.97])
    monkeypatch.setattr(presets, "run", lambda *_: Result(0, 9.0, 7.0, 12_000, next(rates), 1.0, None))
    flags = {"folder": tmp_path, "page": page}
    assert presets.main(Flags(only=("grid-world-ppo", "digits-dqn"), seeds=(0,), **flags)) == 1
    assert presets.main(Flags(only=("grid-world-ppo",), **flags)) == 0
    rows = [line.rpartition(" | ")[0] for line in page.read_text().splitlines() if line.startswith(("| grid", "| dig"))]
    assert rows == [
        "| digits-dqn | 1 of 1 | 100 % | 100 % | - | 12,000 (12,000 to 12,000) | 7 s (7 to 7)",
        "| grid-world-ppo | 3 of 3 | 98 % (95.2 % to 100 %) | 97 % | - | 12,000 (12,000 to 12,000) | 7 s (7 to 7)",
    ]


def test_returns_are_shown_where_there_is_no_success():
    results = [Result(0, 9.0, 9.0, 8_000, None, reward, -200.0) for reward in (-150.0, -170.0)]
    line = presets.row("Pendulum-v1-ppo", [*results, Result(3, 9.0, 9.0, 0, None, None, None)])
    start = "| Pendulum-v1-ppo | 2 of 3 | -160 | -170 | -172.2 | 8,000 (8,000 to 8,000) | 9 s (9 to 9) | 20"
    assert line.startswith(start)


def test_an_unknown_preset_is_refused_with_what_may_be_meant():
    with pytest.raises(InvalidValue, match=r"^--only: there is no preset 'grid-ppo' to train with\. Did you mean "):
        presets.main(Flags(only=("grid-ppo",)))
