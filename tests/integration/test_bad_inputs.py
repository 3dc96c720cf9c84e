"""What users get wrong ends in one line that says what and where, and exit code 2; nothing is written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from helpers.command import ssad

SUITE = "name: a\nsystems: [blind]\nscenarios: [RightTurn]\n"
SCENE = "- name: a\n  type: Custom\n  town: ProvingGround\n  route: [{x: 217, y: -5.25}, {x: 317, y: -5.25}]\n"
ROUTE = "- name: a\n  type: Custom\n  town: ProvingGround\n  route: "
FILES = {
    "empty.yaml": "",
    "list.yaml": "- 1\n",
    "tabs.yaml": "name: a\n\tkind: driving\n",
    "latin.yaml": b"name: caf\xe9\n",
    "twice.yaml": "name: a\nname: b\n",
    "nan.yaml": f"{SUITE}timeout_s: .nan\n",
    "less.yaml": f"{SUITE}repetitions: -3\n",
    "kinds.yaml": "kind: [driving]\n",
    "bomb.yaml": "a: &a [x,x,x,x,x,x,x,x,x]\n"
    + "".join(f"{n}: &{n} [{','.join([f'*{m}'] * 9)}]\n" for m, n in zip("abcd", "bcde", strict=True)),
    "one.yaml": f"{ROUTE}[{{x: 217, y: -5.25}}]\n",
    "far.yaml": f"{ROUTE}[{{x: 1.0e9, y: 0}}, {{x: 1.0e9, y: 50}}]\n",
    "tank.yaml": f"{SCENE}  actors: [{{name: b, model: tank, pose: {{x: 250, y: -5}}}}]\n",
    "back.yaml": f"{SCENE}  actors: [{{name: b, model: suv, pose: {{x: 250, y: -5}}, "
    "trajectory: [[1, 250, -5, 0], [0, 260, -5, 0]]}]\n",
    "mute.py": "class A:\n    def reset(self, episodes): ...\n",
    "boom.py": "raise ValueError('boom\\nagain')\n",
    "ends.py": "import sys\nsys.exit(0)\n",
    "wants.py": "class A:\n    def __init__(self, need): ...\n    def reset(self, e): ...\n    def act(self, v): ...\n",
    "odd.py": "number = 3\ndef seven(): return 7\ndef trips(): raise ValueError('no\\nluck')\n"
    "class Mute:\n    name, access = 'mute', 'white-box'\n",
    "run/run.json": '{"identity": 1}',
    "torn/run.json": "no json",
    "odd/run.json": '{"identity": 1, "suite": {"name": "a"}, "kind": "driving"}',
    "odd/results.jsonl": '{"key": 3}\n',
    "picture.jpg": "no picture",
    "zero.png": "",
    "nus/v1.0-mini/sample_data.json": "[]",
    "folder/image_2/0.png": "no picture",
    "map.xodr": '<OpenDRIVE><road id="1"/></OpenDRIVE>',
    "entity.xodr": '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><OpenDRIVE>&x;</OpenDRIVE>',
    "routes/a.xml": "<routes/>",
    "scene.xosc": "<OpenSCENARIO/>",
    "empty/.keep": "",
}
RUN = "run precrash --set"
CASES = (
    ("run empty.yaml", "empty.yaml:1: a suite is a mapping"),
    ("run list.yaml", "list.yaml:1: a suite is a mapping"),
    ("run tabs.yaml", "tabs.yaml:2: not valid YAML"),
    ("run twice.yaml", "twice.yaml:2: key 'name' appears twice"),
    ("run nan.yaml", "nan.yaml:4: NaN is not a value"),
    ("run less.yaml", "less.yaml:4: repetitions: "),
    ("run kinds.yaml", "kinds.yaml:1: kind: "),
    ("run bomb.yaml", "(a YAML bomb?)"),
    ("run empty/", "unknown suite 'empty/'"),
    (f"{RUN} systems", "expected key=value, such as --set repetitions=3"),
    (f"{RUN} systems=", "systems: Input should be a valid list"),
    (f"{RUN} systems=[blind@a,autopilot@a]", "a name appears twice ('a')"),
    (f"{RUN} systems=[blind@]", "expected NAME@LABEL"),
    (f"{RUN} 'systems=[blind?x=1]'", "unexpected keyword argument 'x'"),
    (f"{RUN} systems=[mute:A]", "needs the methods reset(episodes) and act"),
    (f"{RUN} systems=[boom:A]", "ValueError: boom again"),
    (f"{RUN} systems=[ends:A]", "importing ends failed: SystemExit: 0"),
    (f"{RUN} systems=[wants:A]", "missing a required argument: 'need'"),
    (f"{RUN} systems=[../x:A]", "expected module:object"),
    (f"{RUN} systems=[ppo:none.safetensors]", "none.safetensors: no such file"),
    (f"{RUN} systems=[leaderboard:none.py]", "none.py: no such file"),
    (f"{RUN} systems=[blind] --set scenarios=one.yaml", "one.yaml:4: [0].route: a route needs at least two"),
    (f"{RUN} systems=[blind] --set scenarios=far.yaml", "far.yaml:4: [0].route[0]: beyond 100000 m"),
    (f"{RUN} systems=[blind] --set scenarios=tank.yaml", "unknown model 'tank'; closest: "),
    (f"{RUN} systems=[blind] --set scenarios=back.yaml", "times must increase from row to row"),
    (f"{RUN} systems=[blind] --set scenarios=empty", "no scenario files (*.yaml) in this folder"),
    ("run digital-quick --set attacks=[odd:number]", "attack 'odd:number', of type int, lacks name, access, perturb"),
    (
        "run digital-quick --set attacks=[odd:Mute]",
        "attack 'odd:Mute', of type Mute, lacks perturb; it needs name, ",
    ),
    ("run digital-quick --set attacks=[odd:trips]", "attack 'odd:trips': making it failed: ValueError: no luck"),
    (
        "run digital-quick --set detectors=[odd:seven]",
        "detector 'odd:seven', of type int, lacks task, classes",
    ),
    ("run digital-quick --set detectors=[odd:trips]", "making it failed: ValueError: no luck"),
    ("run digital-quick --set 'attacks=[{name: pgd, norm: l7}]'", "attacks[0].norm: Input should be"),
    ("run latin.yaml", "latin.yaml: not UTF-8 text (byte 9)"),
    (f"{RUN} repetitions=1000000000", "less than or equal to 100000"),
    ("run precrash --only colour=red", "unknown field of cells 'colour'; closest: "),
    (f"{RUN} a.b=3", "unknown key 'a'; closest: "),
    (f"{RUN} name=../../etc", "name: String should match pattern"),
    (f"{RUN} seed=1e400", "seed:1: 1e400 is too large for a number"),
    (f"{RUN} pictures=[nothing]", "pictures[0]: Input should be 'shifts' or 'camera'"),
    ("run precrash --device tpu", "--device tpu: expected auto, cpu or cuda"),
    ("report run", "the run has no results yet"),
    ("report odd", "odd/results.jsonl:1: key is 3, which is no key of a cell; restore the file"),
    ("report torn", "torn/run.json:1: not valid JSON"),
    ("report picture.jpg", "not a results folder"),
    ("replay run x", "run/run.json: not what ssad run writes: no key 'suite'"),
    ("compare run run", "a run is compared with itself"),
    ("shift picture.jpg sheet.png", "picture.jpg: not a JPEG, PNG, TIFF, BMP, WebP or PNM image"),
    ("shift zero.png sheet.png", "(the file is empty)"),
    ("shift folder folder", "which it would become a part of"),
    ("shift folder out --severity 9", "expected comma-separated numbers from 1 to 5, or random"),
    ("shift folder picture.jpg/out", "picture.jpg/out: cannot write there"),
    ("shift nus out", "nus/v1.0-mini/attribute.json: no such file"),
    ("shift empty out --verify", "out: not written by ssad shift"),
    ("show empty out", "no folder v1.0-*"),
    ("detect empty out", "no nuScenes folder"),
    ("import map map.xodr", "road 1: <road> has no attribute 'length'"),
    ("import map entity.xodr", "refused: it declares a DTD"),
    ("import routes routes", "no <route> in it"),
    ("export RightTurn/00 out --format wizard", "'--format': 'wizard' is not one of"),
    ("export RightTurn/00 out", "Missing option '--format'. Choose from: openscenario, leaderboard"),
    ("import openscenario scene.xosc out.yaml", "scene.xosc"),
    ("record out --seconds inf", "'--seconds': Input should be less than or equal to 3600"),
    ("record out --towns Nowhere", "unknown town 'Nowhere'"),
    ("train driver ppo --out picture.jpg", "picture.jpg: cannot write there"),
    ("train driver a2c", "unknown algorithm 'a2c'; closest: "),
)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of files that are wrong, each in its own way."""
    folder = tmp_path_factory.mktemp("wrong")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def list_files(folder: Path) -> list[Path]:
    """Return the files below a folder, without the byte code of the modules that earlier commands imported from it."""
    return [path for path in sorted(folder.rglob("*.*")) if "__pycache__" not in path.parts]


@pytest.mark.parametrize(("words", "told"), CASES, ids=[words for words, _ in CASES])
def test_a_mistake_ends_in_one_line(words: str, told: str, wrong: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(wrong)
    before = list_files(wrong)
    done = ssad(*shlex.split(words))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert told in done.stderr
    assert list_files(wrong) == before
