from bam_envs.remote.serve.robot_service import CommandSlot, Order


def test_what_came_is_taken_once():
    slot = CommandSlot()
    assert slot.take() == Order()
    slot.put("a", [1, 2], [0.1, 0.2], complete=False, tag="x")
    assert slot.take() == Order({1: 0.1, 2: 0.2}, False, "x", "a")
    assert slot.take() == Order()


def test_messages_of_one_command_come_together_and_the_newest_wins():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=False, tag="first")
    slot.put("a", [6], [0.01], complete=False, tag="")
    assert slot.take(complete=True) == Order()
    slot.put("a", [0], [1.0], complete=True, tag="second")
    assert slot.take(complete=True) == Order({6: 0.01, 0: 1.0}, True, "second", "a")
    assert slot.take(complete=True) == Order()


def test_the_messages_of_two_clients_are_not_mixed():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=True, tag="")
    slot.put("b", [0], [1.0], complete=False, tag="")
    assert slot.take() == Order({0: 1.0}, False, "", "b")


def test_it_forgets():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=True, tag="")
    slot.take()
    assert slot.take() == Order()
