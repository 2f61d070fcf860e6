"""The configuration of a run. Its keys are the fields of dataclasses; the files in `conf/` only override defaults."""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch

from padgs.baselines import METHODS
from padgs.checks import ConfigError, Key, check, check_known, lookup, typed, unknown
from padgs.clock import cores
from padgs.data import LOADERS
from padgs.data.capture import DataOptions, DataSettings
from padgs.data.datasets import DATASETS
from padgs.data.perturb import StressOptions
from padgs.data.synthetic.options import SCENES, SyntheticOptions
from padgs.evaluation.protocols import PROTOCOLS, Protocol
from padgs.native import cuda
from padgs.render import RenderConfig
from padgs.runs.store import Labels
from padgs.runs.tracking import TrackingOptions
from padgs.runs.warm_start import WarmStart
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import PUBLISHED_ITERATIONS

DEFAULT_METHOD = "padgs_plus"  # as conf/config.yaml says
RETRIES = ("none", "failed")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class DataConfig(DataSettings):
    """The `data` group: the source of the scene."""

    format: str = "synthetic"  # auto | synthetic | a format that `padgs convert --help` lists
    path: str | None = None  # folder of the scene; null for a generated scene
    voxel_size: float | str = "auto"  # distance of anchors, as the paper states it for a dataset

    def __post_init__(self) -> None:
        super().__post_init__()
        check_known(self, format=("auto", *LOADERS))
        check(self, "null, or not empty (is a variable of the shell unset?)", lambda path: path != "", "path")
        if self.dataset is not None:
            check_known(self, dataset=DATASETS)
        _ = self.synthetic

    @property
    def synthetic(self) -> SyntheticOptions:
        """Options of a generated scene; a ConfigError names an unknown key or a value of the wrong type."""
        is_generated = self.path is None or self.format == "synthetic"
        width = {"width": self.width} if is_generated and self.width is not None else {}
        return typed(SyntheticOptions, {**self.generator, **width}, "data.generator")

    def options(self, device: str) -> DataOptions:
        """Return the options of the loader; decoded images are kept on `device`."""
        return DataOptions(**{field.name: getattr(self, field.name) for field in fields(DataSettings)}, device=device)


@dataclass(frozen=True)
class TrainConfig(TrainOptions):
    """The `train` group: options and length of the training."""

    iterations: int = PUBLISHED_ITERATIONS  # training iterations of one view each; schedules scale with them
    max_seconds: float | None = None  # training time after which the run ends with status timeout

    def __post_init__(self) -> None:
        super().__post_init__()
        Budget(self.iterations, self.max_seconds)


@dataclass(frozen=True)
class BudgetOptions:
    """The `budget` group: limits that replace `train.iterations` and the size that densification reaches."""

    seconds: float | None = None  # training time; schedules follow the clock
    clock: str = "wall"  # wall | cpu: CPU time of the process, independent of other load
    gaussians: int | str | None = None  # final number; auto: prune the least important ones after densification
    stop: str = "end"  # end of the schedule | auto: when validation views stop improving

    def __post_init__(self) -> None:
        Budget(1, **asdict(self))
        if self.clock != "wall" and self.seconds is None:
            raise ValueError(f"clock is {self.clock}, but there are no seconds to measure; set budget.seconds")

    def asked(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, by key."""
        usual = asdict(BudgetOptions())
        if self.seconds is not None:
            del usual["clock"]  # always stated beside seconds
        return {name: value for name, value in asdict(self).items() if value != usual.get(name)}


@dataclass(frozen=True)
class RunOptions:
    """The `run` group: options that results depend on at most by rounding; not part of the run id."""

    folder: str = "runs"  # parent of the run folders
    device: str = "auto"  # auto | cpu | cuda; auto: a GPU if it can render this configuration
    jobs: int = 1  # runs at the same time on one machine: conf/launcher
    threads: int | None = None  # threads of one run; null = cores / jobs
    log_every: int = 10  # iterations between lines of log.jsonl
    probe_every: int = 100  # iterations between renders of one test view, the held-out PSNR of the live line
    checkpoint_every: int | None = None  # iterations between checkpoints; null = only by time
    checkpoint_seconds: float = 60.0  # longest time between checkpoints
    pictures: bool = True  # save ground truth | render | error of each test view

    def __post_init__(self) -> None:
        check_known(self, device=DEVICES)
        check(self, "not empty (is a variable of the shell unset?)", bool, "folder")
        counts = ("jobs", "threads", "log_every", "probe_every", "checkpoint_every")
        check(self, "at least 1", lambda count: count is None or count >= 1, *counts)
        check(self, ">= 0", lambda seconds: seconds >= 0, "checkpoint_seconds")

    @property
    def threads_per_job(self) -> int | None:
        """Threads of one run, so that all jobs together use the cores of this process; None: torch's default."""
        if self.threads is not None or self.jobs == 1:
            return self.threads
        return max(1, cores() // self.jobs)


@dataclass(frozen=True)
class Settings:
    """Settings of a run that do not depend on the method."""

    data: DataConfig = DataConfig()
    render: RenderConfig = RenderConfig()
    train: TrainConfig = TrainConfig()
    budget: BudgetOptions = BudgetOptions()
    run: RunOptions = RunOptions()
    stress: StressOptions = StressOptions()
    tracking: TrackingOptions = TrackingOptions()
    variant: str = ""  # name of this setting within an experiment, such as a row of the ablation
    seed: int = 0  # random seed of training, such as of the order of views
    init: WarmStart | None = None  # a finished run of the same method and scene whose model training begins with
    retry: str = "none"  # none | failed: finished runs to start again
    smallest: str = "off"  # on: search for the smallest model after the run, as padgs smallest does

    def __post_init__(self) -> None:
        check_known(self, retry=RETRIES, smallest=("off", "on"))
        check(self, "in [0, 2^63)", lambda seed: 0 <= seed < 2**63, "seed")
        if len(self.variant) > 150:  # a run adds words, and `padgs.results` takes 255 letters
            raise ValueError(f"variant has {len(self.variant)} letters; give at most 150")


@dataclass(frozen=True, kw_only=True)
class RunConfig(Settings):
    """One run, ready to start."""

    method: str  # a name of baselines.METHODS
    options: Any  # of the method
    protocols: dict[str, Protocol]
    labels: Labels = Labels()

    @property
    def preset(self) -> str:
        """Name of the method, or of a file in conf/method."""
        return self.labels.preset or self.method

    @property
    def time(self) -> Budget:
        """Budget of the training."""
        return Budget(self.train.iterations, self.train.max_seconds, **asdict(self.budget))

    @property
    def row(self) -> str:
        """Label of the run within an experiment: variant, stress condition, and warm start."""
        return ", ".join(filter(None, (self.variant, self.stress.title, "continued" if self.init else "")))

    def values(self) -> dict[str, Any]:
        """Return the configuration as plain values in the shape of the YAML files, defaults included.

        Stress, budget and warm start are left out if they are not used, so that they do not change the run id.
        """
        return {
            **({"budget": budget} if (budget := self.budget.asked()) else {}),
            "data": asdict(self.data),
            "method": {"name": self.method, **asdict(self.options)},
            "render": asdict(self.render),
            "train": asdict(self.train),
            "protocol": {name: asdict(protocol) for name, protocol in self.protocols.items()},
            "run": asdict(self.run),
            **({"stress": asdict(self.stress)} if self.stress.title else {}),
            **({} if self.init is None else {"init": asdict(self.init)}),
            "variant": self.variant,
            "seed": self.seed,
        }


def config_from_values(values: Mapping[str, Any], labels: Labels = Labels()) -> RunConfig:  # noqa: B008 - frozen
    """Return the typed configuration of values that Hydra composed; a ConfigError names the key and the known ones."""
    known = (*asdict(Settings()), "method", "protocol")
    for key in values:
        if key not in known:
            inner = [f"{group}.{key}" for group, keys in values.items() if isinstance(keys, Mapping) and key in keys]
            raise ConfigError(unknown("key", Key(key), known, inner))
    name = str(_group(values, "method").get("name", DEFAULT_METHOD))
    if isinstance(values.get("init"), str):  # on the command line; config.yaml of runs has the fields of a WarmStart
        values = {**values, "init": asdict(WarmStart.of(values["init"], name))}
    settings = typed(Settings, {key: value for key, value in values.items() if key not in ("method", "protocol")})
    method = {key: value for key, value in _group(values, "method").items() if key != "name"}
    protocols = _group(values, "protocol")
    try:
        kind = lookup(METHODS, name, "method")
        options = typed(kind.Options, method, "method")
        made = kind(options, settings.render, settings.train, settings.seed)  # refuses options that exclude each other
        rules = {key: _protocol(key, _group(protocols, key, "protocol.")) for key in protocols}
        config = RunConfig(**vars(settings), method=name, options=options, protocols=rules, labels=labels)
        made.refuse_budget(config.time)
        if config.smallest == "on":
            made.refuse_search()
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if not rules:
        raise ConfigError(f"protocol is empty; name at least one of {', '.join(PROTOCOLS)}")
    return config


def _group(values: Mapping[str, Any], key: str, where: str = "") -> Mapping[str, Any]:
    """Return the keys of a group; empty if there is no such group."""
    group = values.get(key, {})
    if not isinstance(group, Mapping):
        raise ConfigError(f"{where}{key} is {group!r}; it must be a group of keys")
    return group


def _protocol(name: str, rules: Mapping[str, Any]) -> Protocol:
    """Return a protocol of which some rules are given, with values of their types."""
    if name not in PROTOCOLS:
        raise ConfigError(unknown("protocol", name, PROTOCOLS))
    return typed(Protocol, {**vars(PROTOCOLS[name]), **rules, "name": name}, f"protocol.{name}")


def method_choices(name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield group and node for Hydra of `method=NAME`, and of its own render and train settings, if it has any.

    These are choices as well, so that a file in `conf/method` can replace them. On a command line that is refused.

    >>> list(method_choices("op43dgs"))[0]
    ('render', {'render': {'projection': 'tangent'}})
    """
    kind = lookup(METHODS, name, "method")
    defaults: list[Any] = [f"/fields/method/{name}@method"]
    for group, own, usual in (("render", kind.RENDER, RenderConfig()), ("train", kind.TRAIN, TrainOptions())):
        if changes := {key: value for key, value in asdict(own).items() if value != getattr(usual, key)}:
            yield group, {group: changes}
            defaults.append({f"override /{group}": name})
    yield "method", {"defaults": defaults}


def scene_choices() -> dict[str, dict[str, Any]]:
    """Return name -> node of `+scene=`; named DATASET_SCENE, so that a sweep can take `+scene=glob(roam360_*)`.

    >>> scene_choices()["ricoh360_cat_tower"]
    {'defaults': [{'override /data': 'ricoh360'}], 'data': {'path': 'data/ricoh360/cat_tower'}}
    >>> scene_choices()["synthetic_outdoor"]
    {'defaults': [{'override /data': 'synthetic'}], 'data': {'generator': {'scene': 'outdoor'}}}
    """
    values = {f"synthetic_{scene}": ("synthetic", {"generator": {"scene": scene}}) for scene in SCENES} | {
        f"{name}_{scene}": (name, {"path": f"data/{known.folder}/{known.place(scene)}"})
        for name, known in DATASETS.items()
        for scene in known.scenes
    }
    return {name: {"defaults": [{"override /data": data}], "data": keys} for name, (data, keys) in values.items()}


def choose_device(name: str, render: RenderConfig, *, strict: bool = False) -> torch.device:
    """Return the device for `run.device`; auto: a GPU that can render, or the CPU (`strict`: if it is asked for)."""
    if (name == "cuda" or render.backend == "cuda") and not torch.cuda.is_available():
        why = "torch finds no GPU with a working driver" if torch.version.cuda else "this torch is built without CUDA"
        wish, way_out = ("run.device", "cpu or auto") if name == "cuda" else ("render.backend", "auto, cpu or torch")
        raise ValueError(f"{wish}=cuda, but {why}; correct that, or set {wish}={way_out}")
    if render.backend == "cuda":
        if name == "cpu":
            raise ValueError("render.backend=cuda renders on a GPU only, not with run.device=cpu; set run.device=auto")
        cuda.library()
    if strict and name == "auto" and render.backend == "auto" and not torch.cuda.is_available():
        raise ValueError("Slurm gave this job a GPU, but torch finds none: correct that, or set run.device=cpu")
    if not torch.cuda.is_available() or name == "cpu":
        return torch.device("cpu")
    gpu = torch.device("cuda", torch.cuda.current_device())
    if name == "cuda":
        return gpu
    if render.backend not in ("auto", "cuda"):  # torch on a GPU is slower than the CPU
        return torch.device("cpu")
    try:
        cuda.require(gpu)
    except (OSError, RuntimeError) as error:
        if strict:
            raise ValueError(f"a GPU is here, but cannot be used: {error}; or set run.device=cpu") from error
        warnings.warn(f"a GPU is here, but the CPU is used: {error}", stacklevel=2)
        return torch.device("cpu")
    return gpu
