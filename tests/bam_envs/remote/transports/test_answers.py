"""Requests that come twice."""

from bam_envs.rosbridge.answers import RecentAnswers


def test_the_first_one_makes_the_answer_and_the_others_get_it():
    answers = RecentAnswers[str]()
    first, mine = answers.claim("a")
    again, yours = answers.claim("a")
    assert (mine, yours) == (True, False)
    first.set_result("yes")
    assert again.result(0) == "yes"


def test_the_oldest_is_forgotten():
    answers = RecentAnswers[str](size=2)
    assert [answers.claim(key)[1] for key in "abc"] == [True] * 3
    assert [answers.claim(key)[1] for key in "cba"] == [False, False, True]
