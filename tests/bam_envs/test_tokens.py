import pytest

from bam_envs.errors import InvalidValue
from bam_envs.tokens import read_token


def test_a_secret_is_read_without_the_white_space_around_it(tmp_path):
    path = tmp_path / "token"
    path.write_text(" se cret \n")
    assert read_token(path) == "se cret"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "cannot be read: No such file or directory."),
        (b" \n", "is empty; put a secret into it."),
        (b"\xff\xfe", "cannot be read: it is not text."),
    ],
)
def test_a_token_file_that_is_none(tmp_path, content, text):
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidValue) as error:
        read_token(str(path))
    assert str(error.value) == f"The token file {path} {text}"
