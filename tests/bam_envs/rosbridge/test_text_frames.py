import pytest

from bam_envs.rosbridge.text_frames import split_texts, text_frame


def unmasked(frame, size, head):
    key, masked = frame[head : head + 4], frame[head + 4 :]
    assert len(masked) == size
    return bytes(byte ^ key[place % 4] for place, byte in enumerate(masked))


def bare(text):
    """The frame in which a server sends a short text."""
    if len(text) < 126:
        return bytes([0x81, len(text)]) + text
    return b"\x81\x7e" + len(text).to_bytes(2, "big") + text


@pytest.mark.parametrize(
    ("size", "head"),
    [
        (0, b"\x81\x80"),
        (1, b"\x81\x81"),
        (125, b"\x81\xfd"),
        (126, b"\x81\xfe\x00\x7e"),
        (65535, b"\x81\xfe\xff\xff"),
        (65536, b"\x81\xff\x00\x00\x00\x00\x00\x01\x00\x00"),
    ],
)
def test_a_text_goes_out_masked(size, head):
    text = bytes(range(256)) * (size // 256) + bytes(range(size % 256))
    frame = text_frame(text)
    assert frame[: len(head)] == head
    assert unmasked(frame, size, len(head)) == text


def test_each_frame_has_a_key_of_its_own():
    assert len({text_frame(b"again") for _ in range(20)}) > 1


def test_whole_texts_are_taken_and_the_rest_is_left():
    texts = [b"{}", b"x" * 125, b"y" * 126, b"z" * 65535]
    data = b"".join(map(bare, texts))
    assert split_texts(data, 65535) == (texts, b"")
    for cut in (1, 2, 3, 60000):
        assert split_texts(data[:-cut], 65535) == (texts[:3], bare(texts[3])[:-cut])


@pytest.mark.parametrize(
    "other",
    [
        b"\x01\x02ab\x80\x01c",  # in two parts
        b"\x82\x02ab",  # binary
        b"\x88\x02\x03\xe8",  # a closing handshake
        b"\x89\x02ab",  # a ping
        b"\xc1\x02ab",  # compressed
        b"\x81\x82abcdxy",  # masked
        b"\x81\x7e\x00\x02ab",  # not the shortest way to say 2
        b"\x81\x7f\x00\x00\x00\x00\x00\x01\x00\x00" + b"a" * 65536,  # long
        b"\x81\x0babcdefghijk",  # longer than allowed
    ],
)
def test_everything_else_is_left_to_autobahn(other):
    data = other + bare(b"after it")
    assert split_texts(bare(b"before it") + data, 10) == ([b"before it"], data)
