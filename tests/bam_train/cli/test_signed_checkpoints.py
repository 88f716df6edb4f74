"""Signed checkpoints: who is trusted, and what was changed after somebody signed."""

import json
import os
import re
import resource
import signal
import stat
import time
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest

from bam_envs.core.location import HERE
from bam_train.checkpoint import MANIFEST, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.checkpoint.signature import make_key, public_path, sign, trust, verify
from bam_train.cli.sign import main
from bam_train.deploy.checkpoint_admission import Admission
from bam_train.errors import CheckpointError, OutputError, SettingsError, UntrustedCheckpoint
from bam_train.policy import onnx_session

SIGNATURE = "bam/signature.json"
REAL = SimpleNamespace(unwrapped=SimpleNamespace(robot=SimpleNamespace(info=SimpleNamespace(simulated=False))))


@pytest.fixture
def key(tmp_path):
    """The private key of alice, whom ``tmp_path / "trusted"`` trusts."""
    path = tmp_path / "keys" / "alice.key"
    make_key(path, "alice")
    trust(path.with_suffix(".pub"), tmp_path / "trusted")
    return path


@pytest.fixture
def keys(tmp_path):
    return tmp_path / "trusted"


@pytest.fixture
def signed(corridor_checkpoint, key):
    """A checkpoint with members for resuming, which alice has signed."""
    path = corridor_checkpoint()
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist() if name != MANIFEST}
    fields = vars(Checkpoint.open(path).manifest)
    others = {"data": b"{}", "bam/resume/counters.json": b'{"steps": 10}', "bam/resume/rng.json": b"[1, 2]"}
    write_checkpoint(path, {k: v for k, v in fields.items() if k not in ("format", "sha256")}, members | others)
    sign(path, key)
    return path


def admit(path, keys, **options):
    """What bam-deploy does before a real robot moves."""
    admission = Admission(Checkpoint.open(path), keys, **options)
    return admission(REAL, HERE), admission


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_a_signed_checkpoint_is_admitted_and_has_its_members(signed, keys):
    before = members_of(signed)
    lines, admission = admit(signed, keys)
    signature = json.loads(before[SIGNATURE])
    assert lines == [f"  signed by alice, {signature['created']}"]
    assert admission.marks == ()
    assert admission.policy.act(np.ones(1, np.float32)) == 1
    assert sorted(signature) == ["algorithm", "created", "format", "public_key", "signature", "signer"]
    assert Checkpoint.open(signed).json("bam/resume/counters.json") == {"steps": 10}


def test_signing_again_replaces_the_signature(signed, keys, key):
    before = members_of(signed)
    sign(signed, key)
    after = members_of(signed)
    assert list(after) == list(before)
    assert {name: data for name, data in after.items() if name != SIGNATURE} == {
        name: data for name, data in before.items() if name != SIGNATURE
    }
    assert verify(Checkpoint.open(signed), keys).signer == "alice"


NAMES = ["data", POLICY, "bam/golden.safetensors", "bam/resume/counters.json", "bam/resume/rng.json"]


def changed(name):
    return lambda members: members | {name: members[name] + b" "}


def removed(name):
    return lambda members: {one: data for one, data in members.items() if one != name}


def renamed(name):
    return lambda members: {one + "2" * (one == name): data for one, data in members.items()}


def swapped(name):
    other = NAMES[NAMES.index(name) - 1]
    return lambda members: members | {name: members[other], other: members[name]}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", [changed, removed, renamed, swapped])
def test_every_change_is_refused_by_the_members_name_before_the_policy_is_loaded(
    signed, keys, monkeypatch, name, change
):
    monkeypatch.setattr(onnx_session, "OnnxSession", lambda *_: pytest.fail("a session was made"))
    write(signed, change(name)(members_of(signed)))
    for allow in (False, True):
        with pytest.raises(CheckpointError) as caught:
            admit(signed, keys, allow_unsigned=allow)
        assert caught.value.member in {name, *(NAMES[NAMES.index(name) - 1 :][:1] if change is swapped else ())}
        assert caught.value.member in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["extra", "bam/resume/more.json", "../escape", "/etc/motd", "C:/x", "a\\b", "bam/../x"]
)
def test_an_added_member_is_refused_by_its_name(signed, keys, monkeypatch, name):
    monkeypatch.setattr(onnx_session, "OnnxSession", lambda *_: pytest.fail("a session was made"))
    write(signed, members_of(signed) | {name: b"more"})
    with pytest.raises(CheckpointError) as caught:
        admit(signed, keys)
    assert caught.value.member == name
    outside = "a name that points outside of the zip" in str(caught.value)
    assert outside == (name not in ("extra", "bam/resume/more.json"))


def test_new_digests_do_not_make_up_for_a_change(signed, keys, forge):
    signature = members_of(signed)[SIGNATURE]
    forge(signed, {"data": b"other"})
    members = members_of(signed)
    manifest = json.loads(members[MANIFEST])
    del manifest["sha256"][SIGNATURE]
    write(signed, members | {MANIFEST: json.dumps(manifest).encode(), SIGNATURE: signature})
    text = (
        r"bam/manifest\.json or bam/signature\.json was altered after alice signed: the signature does not fit\. Copy"
    )
    with pytest.raises(CheckpointError, match=text):
        admit(signed, keys, allow_unsigned=True)


def test_what_was_changed_after_a_stranger_signed_is_refused_too(signed, tmp_path):
    members = members_of(signed)
    other = members[MANIFEST].replace(b'"seed": 0', b'"seed": 1').replace(b'"seed":0', b'"seed":1')
    assert other != members[MANIFEST]
    for change in ({MANIFEST: other}, {"bam/resume/rng.json": b"[1, 3]"}):
        write(signed, members | change)
        with pytest.raises(CheckpointError):
            admit(signed, tmp_path / "nobody", allow_unsigned=True)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("signer", "bob"),
        ("public_key", "A" * 44),
        ("created", "2031-01-01"),
        ("signature", "A" * 86 + "=="),
        ("public_key", None),
    ],
)
def test_every_field_of_the_signature_counts(signed, keys, tmp_path, field, value):
    members = members_of(signed)
    signature = json.loads(members[SIGNATURE])
    if value is None:  # of somebody else who is trusted too
        value = make_key(tmp_path / "bob.key", "bob").text
        trust(tmp_path / "bob.pub", keys)
    write(signed, members | {SIGNATURE: json.dumps(signature | {field: value}).encode()})
    with pytest.raises(CheckpointError, match="the signature does not fit"):
        admit(signed, keys)


@pytest.mark.parametrize("data", [b"{", b"[]", b'{"format": 2}', b"\xff", b"[" * 10_000])
def test_a_signature_that_is_none_is_named(signed, keys, data):
    write(signed, members_of(signed) | {SIGNATURE: data})
    with pytest.raises(CheckpointError, match=r"bam/signature\.json: .*\. Sign it again") as caught:
        admit(signed, keys)
    assert caught.value.member == SIGNATURE


@pytest.mark.parametrize("field", ["public_key", "signature"])
def test_a_signature_of_other_letters_is_named(signed, keys, field):
    members = members_of(signed)
    signature = json.loads(members[SIGNATURE])
    write(signed, members | {SIGNATURE: json.dumps(signature | {field: "é" * len(signature[field])}).encode()})
    with pytest.raises(CheckpointError, match=r"bam/signature\.json: .*\. Sign it again"):
        admit(signed, keys)


def test_a_signature_of_an_absurd_size_is_not_read(signed, keys):
    write(signed, members_of(signed) | {SIGNATURE: bytes(2**24)})
    with pytest.raises(CheckpointError, match=r"bam/signature\.json has 16777216 bytes, expected at most 16384"):
        admit(signed, keys)


def test_an_unsigned_checkpoint_is_refused_or_marked(corridor_checkpoint, keys, key):
    path = corridor_checkpoint()
    text = f"is not signed. Sign it with bam-sign sign {path} --key FILE"
    with pytest.raises(UntrustedCheckpoint) as caught:
        admit(path, keys)
    assert str(caught.value) == f"{path}: {text}, or give --allow-unsigned"
    lines, admission = admit(path, keys, allow_unsigned=True)
    assert lines == [f"  UNSIGNED: {path}: {text}"]
    assert admission.marks == ("UNSIGNED",)


def test_a_simulated_robot_needs_no_signature(corridor_checkpoint):
    admission = Admission(Checkpoint.open(corridor_checkpoint()))
    simulated = SimpleNamespace(robot=SimpleNamespace(info=SimpleNamespace(simulated=True)))
    for env in (SimpleNamespace(unwrapped=simulated), SimpleNamespace(unwrapped=object())):
        assert admission(env, HERE) == []
    assert admission.marks == ()


def test_whom_this_computer_does_not_trust_is_refused(signed, tmp_path):
    nobody = tmp_path / "nobody"
    text = rf"was signed by alice with the key \S{{12}}\.\.\., which {re.escape(str(nobody))} does not trust"
    with pytest.raises(UntrustedCheckpoint, match=text):
        admit(signed, nobody)
    assert admit(signed, nobody, allow_unsigned=True)[1].marks == ("UNSIGNED",)


def test_a_signer_has_the_name_that_this_computer_gave_him(signed, tmp_path, key):
    keys = tmp_path / "others"
    keys.mkdir()
    text = public_path(key).read_text().replace(" alice", " A.Smith")
    (keys / "a.pub").write_text(text)
    assert verify(Checkpoint.open(signed), keys).signer == "A.Smith"


def test_a_file_that_is_replaced_between_two_readings_is_noticed(signed, keys, corridor_checkpoint):
    checkpoint = Checkpoint.open(signed)
    whole = signed.read_bytes()
    corridor_checkpoint(steps=7)
    members = members_of(signed)
    signed.write_bytes(whole)
    write(signed, members_of(signed) | {MANIFEST: members[MANIFEST]})
    with pytest.raises(CheckpointError, match=r"bam/manifest\.json was replaced while it was read\. Try again"):
        verify(checkpoint, keys)


# Keys


def test_a_key_is_secret_and_is_not_overwritten(tmp_path, key):
    assert key.stat().st_mode & 0o777 == 0o600
    assert public_path(key).read_text().split()[::2] == ["ed25519", "alice"]
    before = key.read_bytes(), public_path(key).read_bytes()
    with pytest.raises(OutputError, match=r"alice\.key: a key is there already\. Choose another name"):
        make_key(key, "alice")
    (tmp_path / "bob.pub").write_text("")
    with pytest.raises(OutputError, match=r": a folder\. Name the private key in it, such as \S+/alice\.key$"):
        make_key(tmp_path, "bob")
    with pytest.raises(
        SettingsError, match=r"carl\.pub: that is a name for a public key\. Give the private one: \S+carl\.key$"
    ):
        make_key(tmp_path / "carl.pub", "carl")
    assert not list(tmp_path.glob("carl*"))
    with pytest.raises(OutputError, match=r"bob\.pub: a key is there already"):
        make_key(tmp_path / "bob.key", "bob")
    assert not (tmp_path / "bob.key").exists()
    assert (key.read_bytes(), public_path(key).read_bytes()) == before


def elliptic():
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    return ec.generate_private_key(ec.SECP256R1()).private_bytes(*form)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda path: path.chmod(0o640),
            r"others can read this private key \(mode 0640\)\. Run: chmod 600 \S+alice\.key$",
        ),
        (
            lambda path: path.unlink(),
            r"the private key cannot be read: No such file or directory\. Make one with bam-sign",
        ),
        (
            lambda path: path.write_text("no key"),
            r"not a private key without a password\. Make one with bam-sign keygen$",
        ),
        (
            lambda path: path.write_bytes(elliptic()),
            r"expected an Ed25519 key, found \w+\. Make one with bam-sign keygen$",
        ),
        (lambda path: public_path(path).write_text("?"), r"expected one line 'ed25519 KEY NAME', as bam-sign keygen"),
    ],
)
def test_a_key_that_cannot_be_used_is_one_line(signed, key, change, text):
    before = signed.read_bytes()
    change(key)
    with pytest.raises(SettingsError, match=text):
        sign(signed, key)
    assert signed.read_bytes() == before


def test_a_key_without_its_public_file_has_the_name_of_its_file(signed, key, keys):
    public_path(key).unlink()
    assert sign(signed, key).signer == "alice"


@pytest.mark.parametrize("name", ["", "a b", "-x", "a" * 65, "ä"])
def test_a_signer_needs_a_name(tmp_path, name):
    with pytest.raises(SettingsError, match="expected 1 to 64 letters, digits"):
        make_key(tmp_path / "x.key", name)
    assert list(tmp_path.iterdir()) == []


def test_others_must_not_decide_whom_this_computer_trusts(signed, keys, tmp_path, monkeypatch):
    change = "another user can change whom this computer trusts"
    (tmp_path / "open").mkdir()
    keys = keys.rename(tmp_path / "open" / "keys")
    (tmp_path / "link").symlink_to(keys)
    for path, bits in ((keys, 0o020), (keys / "alice.pub", 0o002), (tmp_path / "open", 0o002)):
        mode = path.stat().st_mode
        path.chmod(mode | bits)
        for folder in (keys, tmp_path / "link"):
            with pytest.raises(
                SettingsError, match=rf": {change}: others can write to \S+/{path.name}\. Run: chmod go-w \S+$"
            ):
                verify(Checkpoint.open(signed), folder)
        path.chmod(mode | bits | stat.S_ISVTX)
        if path == tmp_path / "open":  # as in /tmp, others cannot replace what is not theirs
            verify(Checkpoint.open(signed), keys)
        path.chmod(mode)
    with monkeypatch.context() as patch:
        owner = 12345
        if os.geteuid() == 0:
            os.chown(keys, owner, -1)
        else:
            owner = os.geteuid()
            patch.setattr(os, "geteuid", lambda: owner + 1)
        with pytest.raises(SettingsError, match=rf"{keys}: {change}: {keys} belongs to \S+\. Run: chown \S+ {keys}$"):
            verify(Checkpoint.open(signed), keys)
    os.chown(keys, os.geteuid(), -1)
    (keys / "broken.pub").write_text("nonsense")
    with pytest.raises(SettingsError, match=r"broken\.pub: expected one line"):
        verify(Checkpoint.open(signed), keys)


def test_a_folder_of_trusted_keys_is_made_for_its_owner_alone_to_change(signed, key, tmp_path):
    before = os.umask(0o002)
    try:
        trust(public_path(key), tmp_path / "new" / "trusted")
    finally:
        os.umask(before)
    assert verify(Checkpoint.open(signed), tmp_path / "new" / "trusted").signer == "alice"


def test_a_file_in_the_place_of_a_folder_is_named(signed, key, tmp_path):
    file = public_path(key)
    with pytest.raises(OutputError, match=r"x\.key: cannot be written: File exists\. Choose another place$"):
        make_key(file / "x.key", "alice")
    with pytest.raises(OutputError, match=rf"{file}: cannot be made a folder: File exists\. Choose another place$"):
        trust(file, file)
    with pytest.raises(
        SettingsError, match=rf"^{file}: a file, and a folder of public keys is expected\. Give its folder$"
    ):
        verify(Checkpoint.open(signed), file)


def test_another_key_of_a_trusted_name_is_refused(tmp_path, keys, key):
    assert trust(public_path(key), keys) == keys / "alice.pub"
    with pytest.raises(SettingsError, match=r"a private key, which stays secret\. Give the public one: \S+alice\.pub$"):
        trust(key, keys)
    make_key(tmp_path / "other.key", "alice")
    with pytest.raises(SettingsError, match=r"another key of that name is trusted\. Remove that file first"):
        trust(tmp_path / "other.pub", keys)


# The program


def test_from_a_key_to_a_verified_checkpoint(corridor_checkpoint, run, tmp_path, monkeypatch):
    monkeypatch.setenv("BAM_TRUSTED_KEYS", str(tmp_path / "trusted"))
    path, key = corridor_checkpoint(), tmp_path / "me.key"
    assert run(main, "keygen", key, "--name", "a.b@c") == (
        0,
        f"{key}: the private key of a.b@c; keep it secret, and away from the robot\n"
        f"  next      copy {tmp_path / 'me.pub'} to the robot's computer and run there\n"
        "            bam-sign trust me.pub\n",
        "",
    )
    status, out, _ = run(main, "sign", path, "--key", key)
    assert (status, out.startswith(f"{path}: signed by a.b@c, 20")) == (0, True)
    status, out, err = run(main, "verify", path)
    assert (status, out) == (1, "")
    assert "does not trust. If you trust that person, run bam-sign trust with their .pub file" in err
    trusted = tmp_path / "trusted" / "a.b@c.pub"
    assert run(main, "trust", tmp_path / "me.pub") == (0, f"{trusted}: trusted from now on\n", "")
    status, out, _ = run(main, "verify", path)
    assert (status, out.endswith("; every member is as signed\n")) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (("sign", "a.zip"), 1, "--key is missing: the private key that signs. Make one with bam-sign keygen"),
        (("sing", "a.zip"), 2, "sing"),
        (("sign", "a.zip", "--key", "me.pub"), 1, "me.pub: a public key signs nothing. Give the private one"),
        (("sign", "a.zip", "--key", "me.key", "--name", "bob"), 1, "sign has no use for --name; leave it out"),
        (("keygen", "me.key", "--keys", "trusted"), 1, "keygen has no use for --keys; leave it out"),
        (("verify", "a.zip", "--key", "me.key"), 1, "verify has no use for --key; leave it out"),
        (("verify",), 2, "FILE is missing."),
    ],
)
def test_what_is_wrong_is_one_line(run, arguments, status, text):
    found, out, err = run(main, *arguments)
    assert (found, out) == (status, "")
    assert err.startswith("bam-sign: ")
    assert text in err
    assert err.count("\n") == 1


def test_sb3_reads_a_signed_checkpoint(key, tmp_path):
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, policy_kwargs={"net_arch": [4]}, device="cpu")
    model.save(tmp_path / "plain.zip")
    with zipfile.ZipFile(tmp_path / "plain.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    golden = safetensors_file.dump({"action": np.zeros(1)})
    path = tmp_path / "signed.zip"
    write_checkpoint(path, FIELDS, {**members, "bam/golden.safetensors": golden})
    sign(path, key)
    assert PPO.load(path, device="cpu").policy_kwargs == {"net_arch": [4]}


FIELDS = {
    "env": "CartPole-v1",
    "env_kwargs": {},
    "observation_space": {"type": "Box", "shape": [4], "dtype": "float32", "low": "-inf", "high": "inf"},
    "action_space": {"type": "Discrete", "n": 2, "start": 0, "dtype": "int64"},
    "signals": {},
    "period": 0.02,
    "algorithm": "ppo",
    "trainer": "sb3",
    "settings": {},
    "steps": 0,
    "seed": 0,
    "scores": {},
    "versions": {},
    "git_commit": None,
    "created": "2026-01-01T00:00:00Z",
}


def test_verifying_a_megabyte_is_quick(key, keys, tmp_path):
    """Processor time, so that a busy machine does not matter; the figure itself is in the documentation."""
    path = tmp_path / "big.zip"
    write_checkpoint(path, FIELDS, {"bam/resume/big.bin": os.urandom(2**20)})
    sign(path, key)
    checkpoint = Checkpoint.open(path)
    verify(checkpoint, keys)
    begin = time.process_time()
    verify(checkpoint, keys)
    assert time.process_time() - begin < 0.2


def test_a_checkpoint_that_is_not_whole_is_not_signed(signed, key):
    write(signed, changed("bam/resume/rng.json")(members_of(signed)))
    before = signed.read_bytes()
    with pytest.raises(CheckpointError, match=r"bam/resume/rng\.json was altered"):
        sign(signed, key)
    assert signed.read_bytes() == before
    assert [path.name for path in signed.parent.glob("*.zip*")] == [signed.name]


def test_a_full_disk_leaves_everything_as_it_was(signed, key, tmp_path):
    before, names = signed.read_bytes(), sorted(signed.parent.iterdir())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        with pytest.raises(OutputError) as unsigned:
            sign(signed, key)
        with pytest.raises(OutputError, match=r"bob\.key: cannot be written: "):
            make_key(tmp_path / "bob.key", "bob")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert str(unsigned.value) == f"{signed}: cannot be written: File too large. Make room beside it"
    assert (signed.read_bytes(), sorted(signed.parent.iterdir())) == (before, names)
    assert not (tmp_path / "bob.key").exists()
