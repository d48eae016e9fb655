"""A LeRobot checkpoint as a policy, computed in this process.

LeRobot imports transformers, which replaces its own entry in ``sys.modules`` while it is being imported. A second
thread that imports it meanwhile, such as one that loads a policy while another loads an arm's driver, gets a module
without names.

Calls are those of LeRobot 0.4.4 to 0.6.1: ``lerobot.policies.factory`` and ``lerobot.policies.utils``. A checkpoint
does not say which joints it moves, so it is used through a profile alone.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from strands_robots.moved import of_module
from strands_robots.policies.base import Action, PolicyError, Ranges
from strands_robots.policies.checkpoint import ENVIRONMENT, STATE
from strands_robots.policies.decoding import read_json
from strands_robots.policies.preload import PreloadedModels
from strands_robots.policies.profiles import IMAGES, Profile
from strands_robots.utils import ValidationError, missing_extra, shown

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


LEROBOT_IMPORTS = threading.RLock()
"""Held by every import of LeRobot in this package."""


def lerobot_import(name: str) -> ModuleType:
    """Import a module of LeRobot's while no other thread does.

    Raises:
        ModuleNotFoundError: LeRobot, or something that the module needs, is not installed.
    """
    with LEROBOT_IMPORTS:
        return import_module(name)


_MODELS = PreloadedModels()
"""Loaded checkpoints by path and device."""


class LeRobotPolicy:
    """Policy that computes chunks with a checkpoint of LeRobot's.

    A policy that looks at several observations, or averages over chunks, is asked at every control step and has
    ``every_tick`` true.

    Args:
        profile: with ``checkpoint``, a directory on this machine.
        pretrained_name_or_path: that of the profile.

    Raises:
        ValidationError: no profile.
        MissingExtraError: the [lerobot] extra is not installed.
    """

    def __init__(self, profile: Profile | None = None, pretrained_name_or_path: str = "") -> None:
        # Another thread may be importing it for seconds.
        if find_spec("lerobot") is None:
            raise missing_extra("The policy lerobot_local", "lerobot")
        if profile is None or not profile.checkpoint:
            raise ValidationError(
                f"policy_provider lerobot_local needs a profile for {shown(pretrained_name_or_path)}, because a "
                "checkpoint does not say which joints it moves: serve the robot with --policies."
            )
        self._profile = profile
        self._checkpoint = str(Path(profile.checkpoint).expanduser())
        self.uses_cameras = bool(profile.cameras)
        self.every_tick = _needs_every_tick(Path(self._checkpoint))
        self.continues = profile.rtc
        self._answered: Any = None
        self._instruction = ""
        self._loaded: tuple[Any, Any, Any] | None = None

    def warm(self) -> str | None:
        """Load the checkpoint on a thread; see :class:`Warmable`."""
        return _MODELS.warm(self._key, self._load, self._profile.name)

    def reset(self, instruction: str, ranges: Ranges) -> None:
        """Take the loaded checkpoint, or load it."""
        self._loaded = _MODELS.take(self._key, self._load)
        self.restart()
        self._instruction = instruction

    def restart(self) -> None:
        """Forget the observations and the chunk so far."""
        for each in self._loaded or ():
            each.reset()
        self._answered = None

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        if self._loaded is None:
            raise PolicyError("it was not reset")
        return self._computed(self._loaded, observation, self._instruction)

    def act_on(self, observation: Mapping[str, Any], *, played: int, delay: int) -> list[Action]:
        """Return a chunk that goes on from the last one; see :class:`RealTimeChunking`."""
        if self._loaded is None:
            raise PolicyError("it was not reset")
        left = None if self._answered is None else self._answered[:, played:]
        chunk = {"inference_delay": delay, "prev_chunk_left_over": left}
        return self._computed(self._loaded, observation, self._instruction, **chunk)

    def interrupt(self) -> None:
        """Do nothing: a forward pass cannot be interrupted."""

    def close(self) -> None:
        loaded, self._loaded = self._loaded, None
        if loaded is not None:
            _MODELS.give(self._key, loaded)

    @property
    def _key(self) -> tuple[str, str, bool]:
        return self._checkpoint, self._profile.device, self.continues

    def _load(self) -> tuple[Any, Any, Any]:
        """Return model and processors, after one inference that is thrown away.

        Raises:
            PolicyError: the checkpoint does not fit its profile, or answers no finite numbers.
        """
        with LEROBOT_IMPORTS:
            factory = lerobot_import("lerobot.policies.factory")
            lerobot_import("lerobot.policies.utils")
            config = lerobot_import("lerobot.configs.policies").PreTrainedConfig.from_pretrained(self._checkpoint)
            # It imports the model's code.
            kind = factory.get_policy_class(config.type)
        if self._profile.device:
            config.device = self._profile.device
        # Strictly: a weight that is missing would be a random one, with a line in the log.
        model = kind.from_pretrained(self._checkpoint, config=config, strict=True)
        if self.continues:
            _enable_rtc(model, config)
        # A checkpoint that was saved on CUDA has processors that ask for it.
        on_device = {"device_processor": {"device": config.device}}
        before, after = factory.make_pre_post_processors(
            config, pretrained_path=self._checkpoint, preprocessor_overrides=on_device
        )
        loaded = model, before, after
        self._computed(loaded, self._blank(config), self._profile.task or "stand still")
        for each in loaded:
            each.reset()
        return loaded

    def _blank(self, config: Any) -> dict[str, Any]:
        """Return an observation of zeros, with pictures of the checkpoint's sizes."""
        numpy = import_module("numpy")
        blank: dict[str, Any] = dict.fromkeys((*self._profile.state, *self._profile.environment), 0.0)
        for camera in self._profile.cameras:
            feature = config.input_features.get(_feature(camera.key))
            if feature is None:
                raise PolicyError(f"the checkpoint has no picture {camera.key}")
            _, height, width = feature.shape
            blank[camera.short_key] = numpy.zeros((height, width, 3), numpy.uint8)
        return blank

    def _computed(
        self, loaded: tuple[Any, Any, Any], seen: Mapping[str, Any], task: str, **chunking: Any
    ) -> list[Action]:
        """Return the chunk that the checkpoint answers, by the profile's action keys."""
        model, before, after = loaded
        numpy, torch, profile = import_module("numpy"), import_module("torch"), self._profile
        frame = {STATE: numpy.array([seen[key] for key in profile.state], numpy.float32)}
        if profile.environment:
            frame[ENVIRONMENT] = numpy.array([seen[key] for key in profile.environment], numpy.float32)
        frame |= {_feature(camera.key): seen[camera.short_key] for camera in profile.cameras}
        utils = import_module("lerobot.policies.utils")
        # Real-time chunking differentiates, which inference mode forbids.
        with torch.no_grad() if self.continues else torch.inference_mode():
            batch = before(utils.prepare_observation_for_inference(frame, torch.device(model.config.device), task, ""))
            answer = model.select_action(batch) if self.every_tick else model.predict_action_chunk(batch, **chunking)
            self._answered = answer
            chunk = after(answer).to("cpu", torch.float64).numpy()
        chunk = chunk[0] if chunk.ndim == 3 else chunk
        if chunk.ndim != 2 or chunk.shape[1] != len(profile.action):
            raise PolicyError(
                f"the checkpoint answered actions of the shape {chunk.shape}, and the profile has "
                f"{len(profile.action)} keys"
            )
        if not numpy.isfinite(chunk).all():
            raise PolicyError("the checkpoint answered actions that are no finite numbers")
        return [dict(zip(profile.action, map(float, row), strict=True)) for row in chunk]


def _enable_rtc(model: Any, config: Any) -> None:
    """Have the model's chunks go on from one another.

    Raises:
        PolicyError: policies of its type cannot.
    """
    if not hasattr(config, "rtc_config") or not hasattr(model, "init_rtc_processor"):
        raise PolicyError(f"a policy of the type {config.type} has no real-time chunking; leave rtc out")
    config.rtc_config = lerobot_import("lerobot.policies.rtc.configuration_rtc").RTCConfig(enabled=True)
    model.init_rtc_processor()


def _feature(key: str) -> str:
    """Return the full name of a picture, as the checkpoint has it."""
    return key if key.startswith("observation.") else IMAGES + key


def _needs_every_tick(directory: Path) -> bool:
    """Return True for a policy with a history, or with an average over chunks."""
    try:
        config = read_json(directory / "config.json")
    except (OSError, ValueError):
        # The check refuses it, with the reason.
        return False
    if not isinstance(config, dict):
        return False
    steps = config.get("n_obs_steps", 1)
    return (isinstance(steps, int) and steps > 1) or config.get("temporal_ensemble_coeff") is not None
