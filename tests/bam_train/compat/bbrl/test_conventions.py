"""Agents that take a time, a seed, a file, which algorithms inherit from all at once; objects from configurations."""

import pickle
from collections import OrderedDict
from fractions import Fraction
from types import SimpleNamespace

import pytest

from bam_train.errors import LoopError, OutputError, SettingsError
from bam_train.loop import (
    Agent,
    SeedableAgent,
    SeedableAgentLast,
    SeedableAgentMean,
    SeedableAgentSum,
    SerializableAgent,
    TimeAgent,
    Workspace,
    get_arguments,
    get_class,
    instantiate_class,
    load,
)


class Actor(TimeAgent, SeedableAgent, SerializableAgent):
    """As algorithms write it."""

    def __init__(self, gain, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.gain = gain

    def forward(self, t, **kwargs):
        self.seen = t


class Unpicklable(SerializableAgent):
    def __init__(self):
        super().__init__()
        self.function = lambda: None


class Lean(Unpicklable):
    def serialize(self):
        return Actor(3)


def test_all_conventions_at_once():
    actor = Actor(2, name="actor", seed=5)
    assert (actor.gain, actor.name, actor._seed) == (2, "actor", 5)
    assert [isinstance(actor, kind) for kind in (Agent, TimeAgent, SeedableAgent, SerializableAgent)] == [True] * 4
    actor(Workspace(), t=4)
    assert actor.seen == 4


def test_a_time_agent_has_to_have_a_forward():
    with pytest.raises(NotImplementedError):
        TimeAgent()(Workspace(), t=0)


def test_one_seed_only():
    agent = SeedableAgent()
    assert agent._seed is None
    assert agent.seed(3) is agent
    assert agent._seed == 3
    with pytest.raises(LoopError) as error:
        agent.seed(4)
    assert str(error.value) == (
        "SeedableAgent is seeded with 3 already and cannot be seeded with 4; "
        "SeedableAgentLast, SeedableAgentSum and SeedableAgentMean take several seeds."
    )
    assert agent._seed == 3


@pytest.mark.parametrize(("kind", "expected"), [(SeedableAgentLast, 5), (SeedableAgentSum, 11), (SeedableAgentMean, 3)])
def test_several_seeds(kind, expected):
    agent = kind(name="a")
    for seed in (2, 4, 5):
        agent.seed(seed)
    assert agent._seed == expected
    assert agent.name == "a"


def test_saving_and_loading(tmp_path):
    Actor(7, name="actor").save(tmp_path / "actor.pickle")
    with open(tmp_path / "actor.pickle", "rb") as file:
        assert pickle.load(file).gain == 7
    actor = load(tmp_path / "actor.pickle")
    assert isinstance(actor, Actor)
    assert (actor.gain, actor.name) == (7, "actor")
    assert load(str(tmp_path / "actor.pickle")).gain == 7


def test_what_is_saved_can_be_chosen(tmp_path):
    Lean().save(tmp_path / "lean.pickle")
    assert load(tmp_path / "lean.pickle").gain == 3


def test_what_cannot_be_saved_leaves_no_file(tmp_path):
    with pytest.raises(LoopError) as error:
        Unpicklable().save(tmp_path / "agent.pickle")
    assert str(error.value).startswith("Unpicklable cannot be saved: ")
    assert str(error.value).endswith("; override serialize().")
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_not_there_or_no_pickles(tmp_path):
    with pytest.raises(LoopError) as missing:
        load(tmp_path / "none.pickle")
    assert str(missing.value).startswith(f"{tmp_path}/none.pickle: no agent can be loaded: ")
    for content in ("hello", "cgone\nActor\n.", "cmath\nActor\n."):  # a class that is not here, or no longer there
        (tmp_path / "text.pickle").write_text(content)
        with pytest.raises(LoopError, match=r"text\.pickle: no agent can be loaded: "):
            load(tmp_path / "text.pickle")
    with pytest.raises(OutputError) as folder:
        Actor(1).save(tmp_path / "nowhere" / "actor.pickle")
    assert str(folder.value) == f"{tmp_path}/nowhere/actor.pickle: cannot be written: No such file or directory"


CONFIG = {"classname": "fractions.Fraction", "numerator": 3, "denominator": 4}


class Config:
    """Attribute access and dict(), as an OmegaConf configuration has them."""

    def __init__(self, entries):
        self._entries = entries

    def __getattr__(self, name):
        return self._entries.get(name)

    def keys(self):
        return self._entries.keys()

    def __getitem__(self, name):
        return self._entries[name]


@pytest.mark.parametrize("kind", [dict, OrderedDict, Config, lambda entries: SimpleNamespace(**entries)])
def test_class_arguments_and_object(kind):
    config = kind(CONFIG)
    assert get_class(config) is Fraction
    assert get_arguments(config) == {"numerator": 3, "denominator": 4}
    assert instantiate_class(config) == Fraction(3, 4)


def test_a_configuration_is_not_changed():
    config = dict(CONFIG)
    instantiate_class(config)
    get_arguments(config)["numerator"] = 5
    assert config == CONFIG


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({}, 'classname: expected a path such as "package.module.Class", found none.'),
        ({"classname": 3}, 'classname: expected a path such as "package.module.Class", found 3.'),
        ({"classname": "Fraction"}, "classname: expected a path such as \"package.module.Class\", found 'Fraction'."),
        (
            {"classname": "fractions.Fractoin"},
            "classname 'fractions.Fractoin': module 'fractions' has no 'Fractoin'. Did you mean 'Fraction'?",
        ),
        (
            {"classname": "numbers.Zzz"},
            "classname 'numbers.Zzz': module 'numbers' has no 'Zzz'. "
            "Choose from: ABCMeta, Complex, Integral, Number, Rational, Real, abstractmethod.",
        ),
        (
            {"classname": "fractoins.Fraction"},
            "classname 'fractoins.Fraction': No module named 'fractoins'; install it or correct the name.",
        ),
        (3, "configuration: expected a mapping with a classname, found 3."),
    ],
)
def test_what_is_wrong_is_named(config, message):
    with pytest.raises(SettingsError) as caught:
        instantiate_class(config)
    assert str(caught.value) == message


def test_a_module_whose_own_import_is_missing(tmp_path, monkeypatch):
    (tmp_path / "needs_more.py").write_text("import not_there_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SettingsError) as caught:
        get_class({"classname": "needs_more.Thing"})
    assert (
        str(caught.value)
        == "classname 'needs_more.Thing': No module named 'not_there_at_all'; install it or correct the name."
    )
