"""Real time on a grid."""

from bam_envs.remote.serve.pace import Pace


def test_steps_end_on_a_grid_and_lateness_does_not_add_up():
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(round(seconds, 6))
        now[0] += seconds + 0.001  # a clock of the real world wakes late

    pace = Pace(0.05, lambda: now[0], sleep)
    pace.restart()
    for work in (0.01, 0.02, 0.0):
        now[0] += work
        pace.wait()
    assert slept == [0.04, 0.029, 0.049]
    assert round(now[0] - 100.0, 6) == 0.151


def test_a_little_late_is_caught_up_and_much_later_begins_a_new_grid():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(round(seconds, 6))
        now[0] += seconds

    pace = Pace(0.1, lambda: now[0], sleep)
    pace.restart()
    now[0] = 0.12  # the step was to end at 0.1
    pace.wait()
    pace.wait()
    assert (slept, round(now[0], 6)) == ([0.08], 0.2)
    now[0] = 0.36  # it was to end at 0.3
    pace.wait()
    pace.wait()
    assert (slept, round(now[0], 6)) == ([0.08, 0.1], 0.46)
