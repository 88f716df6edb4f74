import os

import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import Credentials
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.tokens import Guesses, TokenFile, Tokens, read_token, read_tokens


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "cannot be read: No such file or directory. Write a secret into a file that only you can read."),
        (b" \n", "is empty; put a secret into it."),
        (b"\xff\xfe", "cannot be read: it is not text. Write a secret into a file that only you can read."),
    ],
)
def test_a_token_file_that_is_none(tmp_path, content, text):
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
        path.chmod(0o600)
    with pytest.raises(InvalidValue) as error:
        read_token(str(path))
    assert str(error.value) == f"The token file {path} {text}"


@pytest.mark.skipif(os.name != "posix", reason="elsewhere a mode says nothing")
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o666])
def test_a_token_file_is_its_users_alone(tmp_path, mode):
    path = tmp_path / "token"
    path.write_text("secret")
    path.chmod(mode)
    with pytest.raises(InvalidValue) as error:
        Endpoint("ws://10.0.0.5:9090", Credentials.of(token_file=path))
    assert str(error.value) == f"The token file {path} is open to other users of this computer. Run: chmod 600 {path}"
    path.chmod(0o600)
    assert Endpoint("ws://10.0.0.5:9090", Credentials.of(token_file=path)).token == "secret"


def test_roles():
    tokens = Tokens.of_clients("secret", "mine")
    shown = [[], [""], ["secre"], ["secret"], ["x", "mine"], ["mine", "secret"], ["\ud800"]]
    assert [tokens.role(one) for one in shown] == [None, None, None, "drive", "administer", "administer", None]
    only_operator = Tokens.of_clients(None, "mine")
    assert (tokens.needed, only_operator.needed, Tokens.of_clients().exist) == (True, False, False)
    assert (only_operator.otherwise, only_operator.role(["secret"])) == ("drive", None)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (("", None), "Token: expected a text, found an empty one."),
        (("a", ""), "Token: expected a text, found an empty one."),
        (("a", "a"), "The operator's token must be another one than that of the clients."),
    ],
)
def test_tokens_that_cannot_be(given, text):
    with pytest.raises(InvalidValue) as error:
        Tokens.of_clients(*given)
    assert str(error.value) == text


@pytest.fixture
def token_file(tmp_path):
    path = tmp_path / "tokens"
    path.touch(0o600)
    return path


@pytest.mark.parametrize(
    ("content", "secrets"),
    [
        ("one\n", {"one": "administer"}),
        ("drive one", {"one": "drive"}),
        (
            "# the console on the wall\nwatch one\n\n  drive two\ndrive three\nadminister\tfour\n",
            {"one": "watch", "two": "drive", "three": "drive", "four": "administer"},
        ),
    ],
)
def test_the_token_file_of_a_server(token_file, content, secrets):
    token_file.write_text(content)
    assert read_tokens(token_file) == secrets


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (
            "drive one\ndriv two",
            ", line 2: expected watch, drive or administer, a blank and a token; or one token alone in the file, which "
            "administers.",
        ),
        ("drive one\nwatch one", ", line 2: its token has another role above; make a new one."),
        ("# nothing\n", " is empty; put a secret into it."),
    ],
)
def test_a_token_file_of_a_server_that_is_none(token_file, content, text):
    token_file.write_text(content)
    with pytest.raises(InvalidValue) as error:
        read_tokens(token_file)
    assert str(error.value) == f"The token file {token_file}{text}"


def test_a_token_file_that_changes(token_file, caplog):
    token_file.write_text("one")
    tokens = TokenFile(token_file)
    tokens.refresh()
    assert (tokens.version, tokens.role(["one"])) == (0, "administer")
    token_file.write_text("drive two\nwatch")
    tokens.refresh()
    tokens.refresh()
    assert (tokens.version, tokens.role(["one"])) == (0, "administer")
    token_file.write_text("drive two\nwatch three")
    tokens.refresh()
    assert (tokens.version, tokens.role(["one"]), tokens.role(["two"])) == (1, None, "drive")
    token_file.unlink()
    tokens.refresh()
    assert tokens.role(["three"]) == "watch"
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "The tokens stay as they were",
        f"The token file {token_file} has changed; its tokens are the valid ones now.",
        "The tokens stay as they were",
    ]


def tries(guesses, addresses):
    """How many of wrong tokens from `addresses` were looked at."""
    looked = 0
    for address in addresses:
        if guesses.may_try(address):
            guesses.wrong(address)
            looked += 1
    return looked


def test_few_guesses_a_second_from_one_address():
    now = [0.0]
    guesses = Guesses(lambda: now[0])
    for _ in range(3):
        assert tries(guesses, ["10.0.0.1"] * 100) == 4
        now[0] += 1.0
    assert tries(guesses, [f"2001:db8::{k:x}" for k in range(100)]) == 4  # one network


def test_few_guesses_a_second_from_all_and_no_address_is_kept_out_by_others():
    now = [0.0]
    guesses = Guesses(lambda: now[0])
    attackers = [f"10.0.{k}.1" for k in range(200)]
    assert tries(guesses, attackers) == 200  # each once: nobody knows yet who they are
    for _ in range(3):
        now[0] += 1.0
        assert tries(guesses, attackers * 3) <= 35
        assert guesses.may_try("10.1.0.1")
    now[0] += 100.0
    assert guesses.may_try("10.0.0.1")


def test_addresses_are_forgotten_in_the_end():
    guesses = Guesses(lambda: 0.0)
    tries(guesses, [f"10.{k // 250}.{k % 250}.1" for k in range(6000)])
    assert [guesses.may_try(address) for address in ("10.0.0.1", "10.23.249.1")] == [True, False]
