from __future__ import annotations

import ast
import dataclasses
import typing
from pathlib import Path

import pytest

import pgdm
from pgdm.config.compose import compose
from pgdm.config.describe import describe
from pgdm.config.groups import available, conf_dir, groups
from pgdm.config.schema import ExperimentCfg
from pgdm.errors import ConfigError
from pgdm.methods import METHODS


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["num_envs=-1"], "num_envs is -1; it must be at least 1"),
        (["num_envs=0"], "num_envs is 0"),
        (["num_threads=-1"], "num_threads is -1; it must be at least 0"),
        (["total_frames=0"], "total_frames is 0; it must be at least 1"),
        (["seed=-1"], "seed is -1"),
        (["eval.episodes=0"], "eval.episodes is 0; it must be at least 1"),
        (["eval.interval_frames=-1"], "eval.interval_frames is -1"),
        (["checkpoint.keep_last=0"], "checkpoint.keep_last is 0"),
        (["checkpoint.interval_s=0"], "checkpoint.interval_s is 0.0; it must be above 0"),
        (["algo.learning_rate=0"], "algo.learning_rate is 0.0; it must be above 0"),
        (["algo.gamma=1.1"], "algo.gamma is 1.1; it must be between 0 and 1"),
        (["algo.hidden=[256,0]"], r"algo.hidden is \[256, 0\]; every width"),
        (["algo.minibatch_size=300"], r"size 300 does not divide the 4096 .*such as 256$"),
        (["algo.minibatch_size=5000"], "size 5000 does not divide the 4096 .*such as 4096$"),
        (["num_envs=3"], r"num_envs 3 \* algo.steps_per_env 128"),
        (["resume=maybe"], "unknown resume value 'maybe'.*auto, must, never"),
        (["device=gpu"], "unknown device 'gpu'"),
        (["pregrasp.source=mimed"], "unknown pregrasp.source value 'mimed'; did you mean mined"),
        (["tracking.kind=wandb"], "unknown tracking.kind value 'wandb'"),
        (["sim.object_mass=publish"], "unknown sim.object_mass value 'publish'; did you mean pub"),
        (["sim.object_mass=none"], "unknown sim.object_mass value 'none'.*volume"),
        (["method.name=pgmd"], "unknown method.name value 'pgmd'; did you mean pgdm"),
        (["method.reward.tracking_scale=0"], "method.reward.tracking_scale is 0.0; it must be ab"),
        (["method=deepmimic", "method.imitation.space=joint"], "'joint'; did you mean joints"),
        (["method=deepmimic", "method.imitation.form=square"], "did you mean squared"),
        (["method=deepmimic", "method.imitation.scale=0"], "method.imitation.scale is 0.0; it mu"),
        (["method=deepmimic", "method.imitation.grace_steps=-1"], "grace_steps is -1; .* least 0"),
        (["method=full", "method.imitation.max_hand_error=0"], "max_hand_error is 0.0"),
        (["method=graff", "method.contact.form=l2"], "unknown method.contact.form value 'l2'"),
        (["method=curriculum", "method.curriculum.ramp_frames=0"], "ramp_frames is 0; it must be"),
        (["method=deepmimic", "method.imitation=null"], "method.imitation: null is not allowed"),
        (["method.name=graff"], r"missing method.contact; give a value"),
        (["method=graff", "method.contact.weigth=1"], "did you mean method.contact.weight"),
        (["method.name=no_such_module:METHOD"], "cannot import 'no_such_module'.*PYTHONPATH"),
        (["method.name='json:dumps'"], "'dumps' of .* is not a pgdm.methods.Method; it has: none"),
        (["method.name='pgdm.methods.method:'"], "not of the form my_package.module:attribute"),
        (["run_dir=''"], "run_dir is empty"),
        (["task.objects=[]"], "task.objects is empty"),
        (["task.placements=[{body: a, pos_m: [1], quat: null}]"], "pos_m has 1 number, not 3"),
        (["task.placements=[{body: a, pos_m: null, quat: [0,0,0,0]}]"], "quat is zero"),
        (["obs=relative", "hand.points=[]", "hand.fingertips=[]"], "use obs=released"),
        (["shaping=grasp", "hand.fingertips=[]"], "use shaping=soft_end"),
        (["hand.fingertips=[16]"], "fingertips has 16, but hand.points has 16 entries"),
    ],
)  # fmt: skip
def test_rules_between_the_fields(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(["task.tracked_body=a/object", *overrides])


def test_cuda_is_refused_where_there_is_none() -> None:
    import torch

    if torch.cuda.is_available():
        assert compose(["device=cuda"]).device == "cuda"
    else:
        with pytest.raises(ConfigError, match="torch finds no GPU here; use device=cpu"):
            compose(["device=cuda"])


def test_a_gpu_that_the_machine_lacks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for device in ("cuda", "cuda:0", "cuda:1"):
        assert compose([f"device={device}"]).device == device
    with pytest.raises(ConfigError, match=r"device is cuda:7, .* valid: cuda:0, cuda:1$"):
        compose(["device=cuda:7"])
    for wrong in ("cuda:", "cuda:x", "cuda:-1", "cpu:0"):
        with pytest.raises(ConfigError, match=f"unknown device '{wrong}'"):
            compose([f"device='{wrong}'"])


def fields(cls: type, path: str = "") -> dict[str, type]:
    """Return all keys of a configuration, dotted, with the dataclass that has them."""
    found: dict[str, type] = {}
    for name, hint in typing.get_type_hints(cls).items():
        key = f"{path}.{name}" if path else name
        inner = hint if typing.get_origin(hint) is None else typing.get_args(hint)[0]
        if dataclasses.is_dataclass(inner):
            found |= fields(typing.cast(type, inner), key)
        else:
            found[key] = cls
    return found


def all_fields() -> dict[str, type]:
    """Return all keys, those of every method included."""
    found = fields(ExperimentCfg)
    for method in METHODS.values():
        found |= fields(method.config, "method")
    return found


def test_every_key_is_read_somewhere() -> None:
    """A key that no code reads promises something that does not happen."""
    root = Path(pgdm.__file__).parent
    read: set[str] = set()
    for file in root.rglob("*.py"):
        if file.parent.name == "config":  # it checks them all, and uses none
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute):
                read.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                read.add(node.value)
                read.add(node.value.rpartition(".")[2])
    unread = [key for key in all_fields() if key.rpartition(".")[2] not in read]
    assert unread == []


def test_every_field_says_what_it_means() -> None:
    undocumented = []
    for cls in {*all_fields().values(), ExperimentCfg}:
        module = Path(__import__("sys").modules[cls.__module__].__file__ or "")
        tree = ast.parse(module.read_text())
        node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == cls.__name__)
        for field, after in zip(node.body, [*node.body[1:], None], strict=True):
            is_field = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            is_field = is_field and "ClassVar" not in ast.unparse(field.annotation)
            said = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            if is_field and not said:
                undocumented.append(f"{cls.__name__}.{ast.unparse(field.target)}")
            assert not (is_field and field.value), f"{cls.__name__}: defaults live in conf/"
    assert undocumented == []


def test_every_key_in_the_files_has_a_comment() -> None:
    for group in groups():
        inherited: set[str] = set()
        files = {name: describe(conf_dir() / group / f"{name}.yaml") for name in available(group)}
        if group == "task":
            files = {"_tcdm": describe(conf_dir() / "task" / "_tcdm.yaml")}
        for description in files.values():
            if not description.defaults or group == "task":
                inherited |= {key.name for key in description.keys if key.comment}
        for name, description in files.items():
            assert description.title, f"{group}/{name}.yaml has no comment at its top"
            if group in ("experiment", "budget"):  # they set keys of others
                continue
            for key in description.keys:
                known = key.comment or key.name.removeprefix(f"{group}.") in inherited
                assert known or key.name in ("num_envs",), f"{group}/{name}.yaml: {key.name}"
    assert all(key.comment for key in describe(conf_dir() / "config.yaml").keys)
