from bam_envs.remote.serve.command_slot import CommandSlot, Order


def test_what_came_is_taken_once():
    slot = CommandSlot()
    assert slot.take() is None
    slot.put("a", [1, 2], [0.1, 0.2], complete=False, tag="x")
    assert slot.take() == Order({1: 0.1, 2: 0.2}, False, "x", "a")
    assert slot.take() is None


def test_messages_of_one_command_come_together_and_the_newest_wins():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=False, tag="first")
    slot.put("a", [6], [0.01], complete=False, tag="")
    assert slot.take_complete() is None
    slot.put("a", [0], [1.0], complete=True, tag="second")
    assert slot.take_complete() == Order({6: 0.01, 0: 1.0}, True, "second", "a")
    assert slot.take_complete() is None


def test_the_messages_of_two_clients_are_not_mixed():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=True, tag="")
    slot.put("b", [0], [1.0], complete=False, tag="")
    assert slot.take() == Order({0: 1.0}, False, "", "b")


def test_it_forgets():
    slot = CommandSlot()
    slot.put("a", [6], [0.08], complete=True, tag="")
    slot.clear()
    assert slot.take() is None
