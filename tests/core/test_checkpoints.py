"""Weights: files of every kind in, nothing executed; cards; strict fitting with one clear line."""

import json
import pickle
import struct
import tracemalloc
import zipfile
from collections import OrderedDict, defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import Tensor, nn

from ssad.core.checkpoints import (
    WeightsCard,
    copy_matching_weights,
    copy_state,
    hash_state,
    load_card,
    load_weights,
    read_card,
    save_weights,
)
from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.core.safeio import MIB

CARD = WeightsCard(data="drawn", command="ssad train detector toy", seed=3, classes=("car",), metrics={"AP50": 0.5})


class Toy(nn.Module):
    """A network with every kind of state: kernels, norms, a shared and a transposed tensor, a 0-d one."""

    name = "toy"
    classes = ("car", "person")

    def __init__(self, classes: int = 2, width: int = 4) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Conv2d(3, width, 3), nn.BatchNorm2d(width))
        self.head = nn.Conv2d(width, 3 * (5 + classes), 1)
        self.scale = nn.Parameter(torch.tensor(1.5))
        self.register_buffer("turned", torch.arange(6.0).view(2, 3).T)
        self.register_buffer("steps", torch.tensor(7))


def toy(**options: int) -> Toy:
    torch.manual_seed(0)
    return Toy(**options)


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) and a[k].dtype == b[k].dtype for k in a)


def one_line(error: BaseException) -> str:
    assert "\n" not in str(error)
    return str(error)


class Trap:
    """A pickle that makes a file when it is loaded carelessly."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):  # type: ignore[no-untyped-def]
        return exec, (f"open({str(self.path)!r}, 'w').close()",)


class SystemTrap(Trap):
    """The same through the shell."""

    def __reduce__(self):  # type: ignore[no-untyped-def]
        import os

        return os.system, (f"touch {self.path}",)


class LateTrap(Trap):
    """The same through a class of the standard library that runs nothing by itself, whose state is the trap."""

    def __reduce__(self):  # type: ignore[no-untyped-def]
        return pickle.loads, (pickle.dumps(Trap(self.path)),)


STREAMS = pytest.mark.parametrize("zipped", [True, False], ids=["zip", "stream"])


# ---------------------------------------------------------------- PyTorch's own files


@STREAMS
@pytest.mark.parametrize("nest", [(), ("state_dict",), ("model",), ("model", "state_dict")], ids=str)
def test_a_state_dict_is_found_where_it_is_nested(zipped: bool, nest: tuple[str, ...], tmp_path: Path) -> None:
    state = toy().state_dict()
    tree: object = state
    for name in reversed(nest):
        tree = {"epoch": 3, "meta": {"env": "x", "classes": ("car",)}, name: tree, "optimizer": {"state": {0: 1}}}
    torch.save(tree, tmp_path / "a.pth", _use_new_zipfile_serialization=zipped)
    assert same(load_weights(tmp_path / "a.pth"), dict(state))


@STREAMS
def test_what_pytorch_reads_is_read_alike(zipped: bool, tmp_path: Path) -> None:
    base = torch.arange(24.0)
    state = OrderedDict(
        half=base.half(),
        bfloat=base.bfloat16(),
        double=base.double(),
        integer=base.long(),
        byte=base.byte(),
        flag=base > 3,
        window=base[4:16].view(3, 4)[:, 1:3],
        shared=base[8:],
        scalar=base[5],
        none=torch.empty(0, 3),
        parameter=nn.Parameter(base.view(4, 6).T, requires_grad=True),
        repeated=base.view(2, 12)[0],
    )
    torch.save(state, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
    expected = torch.load(tmp_path / "a.pt", weights_only=True)
    found = load_weights(tmp_path / "a.pt")
    assert same(found, {k: v.detach() for k, v in expected.items()})
    assert not any(value.requires_grad for value in found.values())


@STREAMS
def test_a_pickled_module_gives_its_state_dict(zipped: bool, tmp_path: Path) -> None:
    module = toy()
    keeper = SimpleNamespace(module=module)
    for tree in ({"model": module.half(), "ema": None}, {"ema": module, "model": toy()}, module, {"model": keeper}):
        torch.save(tree, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
        if tree.get("model") is keeper if isinstance(tree, dict) else False:
            tree["model"] = keeper.module  # type: ignore[index]
        assert same(load_weights(tmp_path / "a.pt"), dict(module.state_dict()))


@STREAMS
def test_foreign_classes_do_not_matter(zipped: bool, tmp_path: Path) -> None:
    state = defaultdict(list, toy().state_dict())
    tree = {
        "meta": {
            "path": Path("a/b"),
            "array": np.arange(3),
            "scalar": np.float64(3),
            "kind": torch.float16,
            "device": torch.device("cpu"),
            "names": {"a", "b"},
            "space": SimpleNamespace(a=1),
            "call": len,
        },
        "state_dict": state,
    }
    torch.save(tree, tmp_path / "a.ckpt", _use_new_zipfile_serialization=zipped)
    assert same(load_weights(tmp_path / "a.ckpt"), dict(state))


def test_a_prefix_of_parallel_training_goes(tmp_path: Path) -> None:
    state = toy().state_dict()
    torch.save({f"module.{name}": value for name, value in state.items()}, tmp_path / "a.pth")
    assert same(load_weights(tmp_path / "a.pth"), dict(state))


def test_averaged_weights_win(tmp_path: Path) -> None:
    module, average = toy(), Toy()
    torch.save({"model": module.state_dict(), "average": average.state_dict()}, tmp_path / "last.pt")
    assert same(load_weights(tmp_path / "last.pt"), dict(average.state_dict()))


def averaged() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The weights of a training and their averages."""
    return dict(toy().state_dict()), dict(Toy().state_dict())


def prefixed(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": value for name, value in state.items()}


OPTIMISER = {"state": {0: {"exp_avg": torch.ones(3)}}, "param_groups": [{"lr": 0.1}]}


@pytest.mark.parametrize(
    "case",
    [
        # Ultralytics; the same interrupted before the first average; RT-DETR; torchvision's references; timm
        lambda plain, mean: {"model": plain, "ema": mean, "optimizer": OPTIMISER, "updates": 7},
        lambda plain, mean: {"model": mean, "ema": None, "optimizer": OPTIMISER},
        lambda plain, mean: {"model": plain, "ema": {"module": mean, "updates": torch.tensor(7)}},
        lambda plain, mean: {"model": plain, "model_ema": prefixed("module.", mean) | {"n_averaged": torch.tensor(3)}},
        lambda plain, mean: {"state_dict": plain, "state_dict_ema": mean, "optimizer": OPTIMISER},
        lambda plain, mean: {"params": plain, "params_ema": mean},
        lambda plain, mean: {"state_dict": prefixed("module.", plain), "ema_state_dict": prefixed("module.", mean)},
        # mmengine: its average holds the plain weights, and a counter tells it
        lambda plain, mean: {
            "state_dict": mean,
            "ema_state_dict": prefixed("module.", plain) | {"steps": torch.tensor(9)},
        },
        # Lightning and others: both copies in one state dict; mmcv: the plain weights under names without dots
        lambda plain, mean: {"state_dict": prefixed("model.", plain) | prefixed("ema_model.", mean)},
        lambda plain, mean: {"state_dict": plain | prefixed("ema.module.", mean)},
        lambda plain, mean: {"state_dict": mean | {f"ema_{key.replace('.', '_')}": plain[key] for key in plain}},
        # latent diffusion: an average whose names tell no layers
        lambda plain, mean: {
            "state_dict": mean | {f"model_ema.{key.replace('.', '')}": value for key, value in plain.items()}
        },
        lambda plain, mean: prefixed("module._orig_mod.", mean),
    ],
)
def test_the_averaged_copy_is_loaded(case: Any, tmp_path: Path) -> None:
    plain, mean = averaged()
    torch.save(case(plain, mean), tmp_path / "last.pt")
    assert same(load_weights(tmp_path / "last.pt"), mean)


def test_a_line_says_which_copy_is_loaded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain, mean = averaged()
    for tree, message in (
        ({"model": plain, "ema": {"module": mean}, "optimizer": OPTIMISER}, "averaged weights of 'ema.module'; not"),
        ({"model": plain, "ema": {"module": mean}, "optimizer": OPTIMISER}, "not loaded: model, optimizer"),
        (plain | prefixed("model_ema.", mean), "loads the averaged weights 'model_ema.*'; not loaded: "),
        (mean | {f"ema_{key.replace('.', '_')}": plain[key] for key in plain}, "what mmcv has averaged"),
        (plain | {f"model_ema.{key.replace('.', '')}": mean[key] for key in mean}, "tell no layers"),
    ):
        torch.save(tree, tmp_path / "a.pt")
        load_weights(tmp_path / "a.pt")
        captured = capsys.readouterr()
        assert message in captured.err
        assert captured.err.count("\n") == 1
        assert not captured.out
    torch.save({"model": plain, "optimizer": OPTIMISER}, tmp_path / "a.pt")
    load_weights(tmp_path / "a.pt")
    assert not capsys.readouterr().err  # there is nothing to choose


def test_a_checkpoint_of_unnamed_networks_names_them(tmp_path: Path) -> None:
    torch.save({"teacher": toy().state_dict(), "student": toy().state_dict()}, tmp_path / "a.pt")
    with pytest.raises(FormatError, match=r"no state dict .*; entries: teacher, student") as caught:
        load_weights(tmp_path / "a.pt")
    one_line(caught.value)


@STREAMS
@pytest.mark.parametrize("kind", [Trap, SystemTrap, LateTrap])
def test_a_hostile_checkpoint_never_runs(kind: type[Trap], zipped: bool, tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    state = dict(toy().state_dict())
    trees = [
        kind(mark),
        {"state_dict": kind(mark)},
        {"meta": kind(mark), "state_dict": state},
        state | {"x": kind(mark)},
    ]
    for number, tree in enumerate(trees):
        path = tmp_path / f"{number}.pth"
        torch.save(tree, path, _use_new_zipfile_serialization=zipped)
        try:
            load_weights(path)
        except FormatError as error:
            one_line(error)
        else:
            assert number > 1
            assert kind is LateTrap
        assert not mark.exists()
    torch.load(tmp_path / "0.pth", weights_only=False) if kind is Trap and zipped else pickle.loads(
        pickle.dumps(kind(mark))
    )
    assert mark.exists()  # the trap is a real one


def test_a_file_cannot_change_the_reader(tmp_path: Path) -> None:
    """BUILD on what the table gives: on a function, on a class, with slots."""
    state_of = b"}X\x04\x00\x00\x00_makeX\x01\x00\x00\x00aI1\nsb"
    for name in (b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n", b"ctorch\nFloatStorage\n"):
        for build in (state_of, b"N}X\x05\x00\x00\x00_makeI1\ns\x86b"):
            data = b"\x80\x02" + name + build + b"."
            path = tmp_path / "a.pth"
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("a/data.pkl", data)
            with pytest.raises(FormatError):
                load_weights(path)
    torch.save(toy().state_dict(), tmp_path / "b.pth")
    assert same(load_weights(tmp_path / "b.pth"), dict(toy().state_dict()))


def test_a_tensor_beyond_its_storage_is_refused(tmp_path: Path) -> None:
    for size, stride, offset in (
        ((9,), (1,), 0),
        ((2, 2), (5, 1), 0),
        ((3,), (1,), 3),
        ((-1,), (1,), 0),
        ((2**40,), (0,), 0),
    ):
        pid = b"((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuI4\ntQ"
        numbers = b"(" + b"".join(b"I%d\n" % v for v in size) + b"t(" + b"".join(b"I%d\n" % v for v in stride) + b"t"
        tensor = b"ctorch._utils\n_rebuild_tensor_v2\n" + pid + b"I%d\n" % offset + numbers + b"I00\n}tR"
        data = b"\x80\x02}X\x01\x00\x00\x00a" + tensor + b"s."
        path = tmp_path / "a.pth"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", data)
            archive.writestr("a/data/0", struct.pack("<4f", 1, 2, 3, 4))
        with pytest.raises(FormatError, match=r"storage|shape"):
            load_weights(path)


@STREAMS
def test_files_cut_short_or_changed_are_one_line(zipped: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.pth"
    torch.save({"state_dict": toy().state_dict()}, path, _use_new_zipfile_serialization=zipped)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for length in (0, 1, 5, 40, 200, len(whole) // 2, len(whole) - 30, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError) as caught:
            load_weights(path)
        one_line(caught.value)
    for _ in range(300):
        broken = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            broken[at] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            load_weights(path)
        except FormatError as error:
            one_line(error)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_one_line(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    folder = tmp_path_factory.mktemp("bytes", numbered=True)
    for name in ("a.pth", "a.safetensors"):
        (folder / name).write_bytes(data)
        with pytest.raises(FormatError):
            load_weights(folder / name)
    (folder / "a.pth").write_bytes(b"\x80\x02" + data)
    with pytest.raises(FormatError):
        load_weights(folder / "a.pth")


GREEDY = {  # small pickles that ask for much: of memory, of time, of the interpreter's stack
    "a value kept under a huge number": (b"}r" + struct.pack("<I", 1 << 24), "byte 3 of .* as number 16,777,216"),
    "the same as text": (b"}p16777216\n", "byte 3 of .* as number 16,777,216"),
    "the same, read again": (b"}q\x00h\x00r" + struct.pack("<I", 10**6), "byte 7 of .* as number 1,000,000"),
    "many bytes announced": (b"\x96" + struct.pack("<Q", 1 << 28), "268435456 bytes"),
    "a tuple far larger unfolded": (
        b"})" + b"".join(b"q%ch%c\x86" % (k, k) for k in range(28)) + b"I1\ns",
        "more than 5,000,000 steps",
    ),
    "tuples deep inside each other": (b"})" + b"\x85" * 10_000 + b"I1\ns", "more than 5,000,000 steps"),
    "a list copied again and again": (
        b"](" + b"I1\n" * 1000 + b"eq\x00" + b"ctorch\nSize\nq\x01" + b"h\x01h\x00\x85R" * 6000,
        "more than 5,000,000 steps",
    ),
    "a class of every name": (
        b"".join(b"ca\n%d\n" % k for k in range(12_000)),
        "more than 5,000,000 steps",
    ),
    "nothing to take": (b"\x85", "byte 2 of .* a value that is not there"),
}


@STREAMS
@pytest.mark.parametrize("case", GREEDY.values(), ids=GREEDY.keys())
def test_memory_and_time_stay_in_proportion_to_the_file(case: tuple[bytes, str], zipped: bool, tmp_path: Path) -> None:
    steps, words = case
    path, data = tmp_path / "a.pth", b"\x80\x02" + steps + b"."
    if zipped:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", data)
    else:
        path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=words) as caught:
            load_weights(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert one_line(caught.value).startswith(f"{path}: ")
    assert peak < 64 * MIB


@STREAMS
def test_numbers_may_be_shared_but_not_without_end(zipped: bool, tmp_path: Path) -> None:
    base = torch.arange(10_000.0)
    few, many = ({str(k): base[k:] for k in range(count)} for count in (8, 100))
    torch.save(few, tmp_path / "few.pth", _use_new_zipfile_serialization=zipped)
    assert same(load_weights(tmp_path / "few.pth"), few)
    torch.save(many, tmp_path / "many.pth", _use_new_zipfile_serialization=zipped)
    with pytest.raises(FormatError, match="refused: its tensors take more than 16 times its size"):
        load_weights(tmp_path / "many.pth")


def test_other_files_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "plain.pth").write_bytes(pickle.dumps({"a": np.arange(3)}))
    torch.save({"epoch": 3}, tmp_path / "empty.pth")
    with zipfile.ZipFile(tmp_path / "script.pt", "w") as archive:
        archive.writestr("s/data.pkl", pickle.dumps(1))
        archive.writestr("s/constants.pkl", pickle.dumps(()))
    with zipfile.ZipFile(tmp_path / "zip.pt", "w") as archive:
        archive.writestr("readme", "hello")
    torch.save(toy().state_dict(), tmp_path / "named.safetensors")
    (tmp_path / "a.weights").write_bytes(b"x")
    expected = {
        "plain.pth": "pickle, not a PyTorch",
        "empty.pth": "no state dict",
        "script.pt": "TorchScript",
        "zip.pt": "not one that PyTorch",
        "named.safetensors": "pickle under the name",
        "a.weights": "weights are",
        "emptie.pth": "closest: empty.pth",
        "none/x.safetensors": "no such file",
    }
    for name, text in expected.items():
        with pytest.raises(FormatError, match=text) as caught:
            load_weights(tmp_path / name)
        one_line(caught.value)


# ---------------------------------------------------------------- safetensors and cards


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("shard_mb", [15.0, 0.0005])
def test_what_is_saved_is_read_back(half: bool, shard_mb: float, tmp_path: Path) -> None:
    state = dict(toy(width=8).state_dict())
    written = save_weights(tmp_path / "toy.safetensors", state, card=CARD, half=half, shard_mb=shard_mb)
    parts = sorted(tmp_path.glob("*.safetensors"))
    assert len(parts) == 1 if shard_mb > 1 else len(parts) > 2
    for place in (tmp_path / "toy.safetensors", tmp_path, parts[0], parts[-1]):
        found = load_weights(place)
        assert found.keys() == state.keys()
        for name, value in found.items():
            narrow = half and state[name].ndim > 1
            assert value.dtype == (torch.float16 if narrow else state[name].dtype)
            assert torch.equal(value, state[name].to(value.dtype))
    card, again = load_card(tmp_path / "toy.json")
    assert card == written == read_card(parts[0])
    assert card.hash == hash_state(again) == hash_state(load_weights(tmp_path))
    assert card.version
    assert (card.data, card.classes, dict(card.metrics)) == (CARD.data, CARD.classes, CARD.metrics)
    first = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    save_weights(tmp_path / "toy.safetensors", dict(reversed(state.items())), card=CARD, half=half, shard_mb=shard_mb)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == first
    other = toy(width=8)
    nn.init.zeros_(other.head.weight)
    copy_state(other, found, "here")
    assert torch.equal(other.head.weight, state["head.weight"].to(found["head.weight"].dtype).float())


def test_shards_of_older_weights_go(tmp_path: Path) -> None:
    state = dict(toy(width=8).state_dict())
    save_weights(tmp_path / "toy.safetensors", state, card=CARD, shard_mb=0.0005)
    save_weights(tmp_path / "toy-light.safetensors", state, card=CARD)
    save_weights(tmp_path / "toy.safetensors", state, card=CARD, shard_mb=0.001)
    assert same(load_weights(tmp_path / "toy.safetensors"), state)
    save_weights(tmp_path / "toy.safetensors", state, card=CARD)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "toy-light.json",
        "toy-light.safetensors",
        "toy.json",
        "toy.safetensors",
    ]
    with pytest.raises(FormatError, match="2 sets of weights"):
        load_weights(tmp_path)


def test_missing_and_mixed_shards_are_one_line(tmp_path: Path) -> None:
    state = dict(toy(width=8).state_dict())
    save_weights(tmp_path / "toy.safetensors", state, card=CARD, shard_mb=0.0005)
    parts = sorted(tmp_path.glob("*.safetensors"))
    kept = parts[1].read_bytes()
    parts[1].unlink()
    with pytest.raises(FormatError, match=r"1 of \d parts are missing: toy-00002"):
        load_weights(parts[0])
    parts[1].write_bytes(parts[0].read_bytes())
    with pytest.raises(FormatError, match="in another part as well"):
        load_weights(tmp_path)
    parts[1].write_bytes(kept)
    (tmp_path / "toy-00001-of-00099.safetensors").write_bytes(kept)
    with pytest.raises(FormatError, match="parts of 2 sets"):
        load_weights(tmp_path / "toy.safetensors")


def test_an_index_is_followed_within_its_folder(tmp_path: Path) -> None:
    state = dict(toy().state_dict())
    names = sorted(state)
    save_file({k: state[k].contiguous() for k in names[:3]}, tmp_path / "x-1.safetensors")
    save_file({k: state[k].contiguous() for k in names[3:]}, tmp_path / "x-2.safetensors")
    table = {k: "x-1.safetensors" if k in names[:3] else "x-2.safetensors" for k in names}
    (tmp_path / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": table}))
    assert same(
        load_weights(tmp_path / "model.safetensors.index.json"),
        {k: state[k] for k in load_weights(tmp_path / "model.safetensors.index.json")},
    )
    for bad in ({"weight_map": {"a": "../secret.safetensors"}}, {"weight_map": [1]}, []):
        (tmp_path / "model.safetensors.index.json").write_text(json.dumps(bad))
        with pytest.raises(FormatError):
            load_weights(tmp_path / "model.safetensors.index.json")


def test_a_value_that_half_cannot_hold_stays(tmp_path: Path) -> None:
    state = {"a": torch.tensor([[1e5, 1.0]]), "b": torch.tensor([[1.0, 2.0]])}
    save_weights(tmp_path / "a.safetensors", state, card=CARD, half=True)
    found = load_weights(tmp_path / "a.safetensors")
    assert torch.equal(found["a"], state["a"])
    assert found["b"].dtype is torch.float16


def test_a_card_that_lies_is_refused(tmp_path: Path) -> None:
    save_weights(tmp_path / "a.safetensors", toy().state_dict(), card=CARD)
    save_file({k: v.contiguous() + 1 for k, v in toy().state_dict().items()}, tmp_path / "a.safetensors")
    with pytest.raises(FormatError, match="another hash"):
        load_card(tmp_path / "a.json")
    good = json.loads((tmp_path / "a.json").read_text())
    for bad in ([], {}, good | {"seed": "x"}, good | {"classes": [1]}, good | {"metrics": {"a": "x"}}):
        (tmp_path / "a.json").write_text(json.dumps(bad))
        with pytest.raises(FormatError, match=r"a\.json"):
            read_card(tmp_path / "a.safetensors")


def test_a_metric_may_be_undefined(tmp_path: Path) -> None:
    card = WeightsCard("d", "c", 0, ("car",), metrics={"AP": float("nan"), "mAP": np.float32(0.5)})  # type: ignore[dict-item]
    save_weights(tmp_path / "a.safetensors", toy().state_dict(), card=card)
    assert '"AP": null' in (tmp_path / "a.json").read_text()
    found = read_card(tmp_path / "a.json").metrics
    assert np.isnan(found["AP"])
    assert found["mAP"] == 0.5
    with pytest.raises(ConfigError, match="JSON"):
        save_weights(
            tmp_path / "a.safetensors", toy().state_dict(), card=WeightsCard("d", "c", 0, (), config={"a": object()})
        )


def test_a_bad_name_or_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in ("a.pth", "a-00001-of-00002.safetensors", "file/a.safetensors"):
        with pytest.raises(SSADError) as caught:
            save_weights(tmp_path / path, toy().state_dict(), card=CARD)
        one_line(caught.value)


# ---------------------------------------------------------------- fitting


def refused(state: dict[str, Tensor], module: nn.Module | None = None) -> str:
    module = toy() if module is None else module
    before = {name: value.clone() for name, value in module.state_dict().items()}
    with pytest.raises(FormatError) as caught:
        copy_state(module, state, "w.pth")
    assert same(dict(module.state_dict()), before)
    return one_line(caught.value)


def test_fitting_is_strict_and_says_why() -> None:
    state = dict(toy().state_dict())
    assert "1 missing: head.bias" in refused({k: v for k, v in state.items() if k != "head.bias"})
    assert "1 foreign: extra" in refused(state | {"extra": torch.zeros(1)})
    renamed = {k.replace("body.", "trunk."): v for k, v in state.items()}
    text = refused(renamed)
    assert "6 missing: body.0.weight, body.0.bias, body.1.weight, ... (closest: trunk.0.weight)" in text
    assert "7 foreign: trunk.0.weight" in text
    assert "(of 12 names 5 fit)" in text
    assert "made for 80 classes, this detector has 2" in refused(
        state | dict(Toy(classes=80).head.state_dict(prefix="head."))
    )
    assert "another width" in refused(dict(toy(width=8).state_dict()))
    assert "'body.1.running_var' holds 1 NaN or infinite values of 4" in refused(
        state | {"body.1.running_var": torch.tensor([1, torch.inf, 1, 1])}
    )
    assert "holds int8 numbers" in refused(state | {"head.weight": state["head.weight"].to(torch.int8)})
    assert "missing" in refused({})


def test_layers_of_another_shape_or_name_start_fresh() -> None:
    state, module = dict(toy().state_dict()), Toy(classes=80)
    fresh = dict(module.head.state_dict(prefix="head.", keep_vars=False))
    wanted = {k: fresh[k].clone() if k in fresh else v for k, v in state.items()}
    assert copy_matching_weights(module, state | {"other.weight": torch.zeros(2)}, "w.pth") == [
        "head.weight",
        "head.bias",
    ]
    assert same(dict(module.state_dict()), wanted)
    assert copy_matching_weights(toy(), state, "w.pth") == []
    few = {k: v for k, v in state.items() if "head" in k}
    with pytest.raises(FormatError, match="these are not the weights of"):
        copy_matching_weights(Toy(), few, "w.pth")
    with pytest.raises(FormatError, match="NaN or infinite"):
        copy_matching_weights(Toy(), state | {"head.bias": torch.full_like(state["head.bias"], torch.nan)}, "w.pth")


def test_counters_of_steps_may_be_missing() -> None:
    state = {k: v for k, v in toy().state_dict().items() if "num_batches" not in k}
    module = Toy()
    copy_state(module, state, "w.pth")
    assert same({k: v for k, v in module.state_dict().items() if k in state}, state)


def test_buffers_of_other_frameworks_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    state = dict(toy().state_dict())
    module = Toy()
    foreign = {
        "pixel_mean": torch.tensor([103.53, 116.28, 123.675]).view(3, 1, 1),
        "data_preprocessor.std": torch.ones(3, 1, 1),
        "head.anchors": torch.zeros(3, 3, 2),
        "body.total_ops": torch.zeros(1),
    }
    copy_state(module, state | foreign, "w.pth")
    assert same(dict(module.state_dict()), state)
    line = capsys.readouterr().err
    assert line.startswith("w.pth: not loaded, since toy has its own: pixel_mean [103.53, 116.28, 123.675]")
    assert "head.anchors [3, 3, 2]" in line
    assert "foreign: normalizer" in refused(state | {"normalizer": torch.ones(3)})


def test_counters_of_steps_may_be_in_excess(capsys: pytest.CaptureFixture[str]) -> None:
    class Frozen(nn.Module):
        """A norm without a counter."""

        def __init__(self) -> None:
            super().__init__()
            for name in ("weight", "bias", "running_mean", "running_var"):
                self.register_buffer(name, torch.zeros(4))

    state = dict(nn.BatchNorm2d(4).state_dict())
    module = Frozen()
    copy_state(module, state, "w.pth")
    assert torch.equal(module.get_buffer("running_var"), torch.ones(4))
    assert not capsys.readouterr().err
    with pytest.raises(FormatError, match=r"foreign: other\.num_batches_tracked"):
        copy_state(module, state | {"other.num_batches_tracked": torch.tensor(1)}, "w.pth")


def test_modes_and_gradients_stay() -> None:
    module = toy().requires_grad_(False).double()
    module.body.eval()
    copy_state(module, toy().half().state_dict(), "w.pth")
    assert not any(p.requires_grad for p in module.parameters())
    assert all(v.dtype is torch.float64 for v in module.parameters())
    assert module.training
    assert not module.body.training
