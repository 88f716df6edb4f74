"""Descriptions of bases: their signals and shapes, what a file must say, and what makes two of them differ."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot_models import known_models, portable_model, require_same_robot
from bam_envs.robots.base_description import BaseDescription, base_model
from tests.bam_envs.making import CART

SHIPPED = {
    "husky": (0.99, 0.67, (1.0, 2.0), (1.0, 1.0), [720]),
    "mir100": (0.90, 0.58, (1.0, 1.5), (2.0, 2.5), [501, 511]),
    "turtlebot4": (0.342, 0.342, (0.306, 1.9), (0.9, 7.725), [640]),
}


def test_shipped_bases_say_where_their_numbers_come_from():
    assert list(known_models(BaseDescription)) == list(SHIPPED)
    for name, (length, width, fastest, change, rays) in SHIPPED.items():
        base = base_model(name)
        body, spec = base.body, base.spec()
        assert {"footprint", "drive", "lasers"} <= set(base.sources)
        assert body.front + body.back == pytest.approx(length)
        assert body.reach(0.0, 1.0) + body.reach(0.0, -1.0) == pytest.approx(width)
        assert (spec.name, spec.period, spec.body) == (name, 0.1, body)
        assert (spec.command.high, spec.command.max_rate) == (fastest, change)
        assert [len(signal.labels) for signal in spec.signals] == [3, 2, *rays]
        assert base.spec(with_scans=False).signals == spec.signals[:2]


def test_a_mir100_is_what_it_was():
    body = base_model("mir100").body
    assert (body.front, body.back, body.side) == (0.0376 + 0.45, 0.45 - 0.0376, 0.29)
    assert [scanner.signal for scanner in body.scanners] == ["f_scan", "b_scan"]
    assert {one for scanner in body.scanners for one in scanner.contact} == {0.15}
    degrees = [np.degrees(scanner.bearings)[[0, -1]].round(9).tolist() for scanner in body.scanners]
    assert degrees == [[-120.0, 130.0], [-130.0, 125.0]]


def test_a_ray_from_inside_touches_two_centimetres_from_the_footprint():
    (round_one,), (cart,) = base_model("turtlebot4").body.scanners, base_model(CART).body.scanners
    ways = np.array(round_one.bearings) + round_one.pose[2]
    ends = np.array([[-0.04], [0.0]]) + (np.array(round_one.contact) - 0.02) * np.stack([np.cos(ways), np.sin(ways)])
    np.testing.assert_allclose(np.hypot(*ends), 0.171, atol=1e-9)
    ahead, left = (np.argmin(np.abs(np.array(cart.bearings) - way)) for way in (0.0, math.pi / 2))
    assert cart.contact[ahead] == pytest.approx(0.32, abs=1e-3)
    assert cart.contact[left] == pytest.approx(0.32, abs=5e-3)


def changed(*keys, **values):
    """`CART` with other `values` in the table that `keys` lead to; None takes a key away."""
    table = {**CART, "lasers": [dict(CART["lasers"][0])]}
    inner = table
    for key in keys:
        inner[key] = dict(inner[key]) if isinstance(inner[key], dict) else inner[key]
        inner = inner[key]
    inner.update(values)
    for name in [name for name, value in values.items() if value is None]:
        del inner[name]
    return table


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (changed(feet=4), ": unknown key 'feet'. Choose from: drive, footprint, height, lasers, name, sources, title."),
        (changed(drive=None), ": the key 'drive' is missing"),
        (
            changed("drive", kind="tracks"),
            ": drive: kind: expected 'differential' or 'omnidirectional', found",
        ),
        (
            changed("drive", speed=-1.0),
            ": drive: speed: expected a data sheet's m/s, above 0 and at most 20, found -1.0",
        ),
        (
            changed("drive", acceleration=1e9),
            ": drive: acceleration: expected a data sheet's m/s^2, above 0 and at most 100, found 1000000000.0",
        ),
        (changed("drive", turn=None), ": drive: the key 'turn' is missing"),
        (
            changed("drive", kind="differential"),
            ': drive: sideways: a differential drive does not go sideways; give kind = "omnidirectional".',
        ),
        (
            changed(footprint={"corners": [[0.3, 0.0], [0.0, 0.2]]}),
            ": footprint: corners: a footprint has at least 3 corners, and this one has 2; a circle is "
            "{ radius = 0.2 }.",
        ),
        (
            changed(footprint={"corners": [[0.3, 0.0], [0.0, 0.2], [-0.3, 0.0], [0.0, 0.1]]}),
            ": footprint: corners: they must go round a convex polygon, one after the other.",
        ),
        (changed(footprint={"radius": 0.2, "length": 1.0}), ": footprint: give either radius, or length and width, or"),
        (changed(footprint={}), ": footprint: give either radius, or length and width, or corners."),
        (changed("footprint", ahead=0.1), ": footprint: ahead is for a circle or a rectangle; corners say where they"),
        (changed("lasers", 0, beams=0), ": lasers[0]: beams: expected a whole number from 2 to 4096, found 0"),
        (changed("lasers", 0, beams=9999), ": lasers[0]: beams: expected a whole number from 2 to 4096, found 9999"),
        (changed("lasers", 0, range=[3.0, 1.0]), ": lasers[0]: laser: range: the least range must come first."),
        (
            changed("lasers", 0, angles=[0.0, 7.0]),
            ": lasers[0]: laser: angles: the last must be above the first, by",
        ),
        (changed("lasers", 0, hidden=[100, 100]), ": lasers[0]: laser: hidden: 200 of 200 rays leave none."),
        (changed(lasers=CART["lasers"] * 2), ": cart: lasers: two of them have the same name."),
        (changed(lasers=3), ": lasers: expected a list of tables of named values, found 3"),
    ],
)
def test_a_mistake_is_one_line_with_its_key(table, message):
    with pytest.raises(InvalidValue) as caught:
        base_model(table)
    assert str(caught.value).startswith(f"robot_model{message}")
    assert "\n" not in str(caught.value)


def test_corners_may_go_round_either_way():
    corners = CART["footprint"]["corners"]
    other = base_model(changed(footprint={"corners": corners[::-1]}))
    assert sorted(other.body.corners) == sorted(base_model(CART).body.corners)
    x, y = np.array([0.29, 0.0, 0.2, 0.31, 0.0, -0.29]), np.array([0.0, 0.29, 0.26, 0.0, -0.21, -0.19])
    for base in (other, base_model(CART)):
        assert base.body.holds(x, y).tolist() == [True, True, False, False, False, True]


def test_a_name_that_is_not_known():
    with pytest.raises(UnknownName, match="Did you mean 'turtlebot4'"):
        base_model("turtlebot3")


def test_what_a_checkpoint_holds_of_a_base_is_the_base():
    """Whole, with its digest; another one of that name here is refused."""
    assert portable_model("mir100") == "mir100"
    held = portable_model("husky")
    assert base_model(held) == base_model("husky")
    require_same_robot(held)
    with pytest.raises(InvalidValue) as caught:
        base_model({**held, "drive": {**held["drive"], "speed": 2.0}})
    assert str(caught.value) == "robot_model: the description of husky was changed: it does not have its digest."
    wider = replace(base_model("husky"), footprint=replace(base_model("husky").footprint, width=0.7))
    with pytest.raises(InvalidValue) as caught:
        require_same_robot(portable_model(wider))
    assert str(caught.value).startswith("husky is another robot here (")
    assert "footprint.width: 0.7, here 0.67. Give the description with which" in str(caught.value)
