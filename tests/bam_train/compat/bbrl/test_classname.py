from collections import OrderedDict
from types import SimpleNamespace

import pytest

from bam_train.errors import SettingsError
from bam_train.loop import get_arguments, get_class, instantiate_class

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
    from fractions import Fraction

    config = kind(CONFIG)
    assert get_class(config) is Fraction
    assert get_arguments(config) == {"numerator": 3, "denominator": 4}
    assert instantiate_class(config) == Fraction(3, 4)


def test_a_configuration_is_not_changed():
    config = dict(CONFIG)
    instantiate_class(config)
    get_arguments(config)["numerator"] = 5
    assert config == CONFIG


def test_arguments_need_no_classname():
    assert get_arguments({"size": 3}) == {"size": 3}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({}, 'classname: expected a path such as "package.module.Class", found none.'),
        (Config({}), 'classname: expected a path such as "package.module.Class", found none.'),
        ({"classname": 3}, 'classname: expected a path such as "package.module.Class", found 3.'),
        ({"classname": "Fraction"}, "classname: expected a path such as \"package.module.Class\", found 'Fraction'."),
        ({"classname": ".Fraction"}, "classname: expected a path such as \"package.module.Class\", found '.Fraction'."),
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
        (
            {"classname": "json.decodr.JSONDecoder"},
            "classname 'json.decodr.JSONDecoder': No module named 'json.decodr'; install it or correct the name.",
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
