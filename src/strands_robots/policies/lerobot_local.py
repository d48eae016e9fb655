"""A LeRobot checkpoint as a policy, computed in this process.

Written against LeRobot 0.4 (``lerobot.policies.factory`` and ``lerobot.policies.utils``). LeRobot with its torch is
not installed in the tests of this project, so this module is **not verified** beyond its refusals.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from strands_robots.policies.base import Action, Ranges
from strands_robots.policies.warm import WarmModels
from strands_robots.utils import ValidationError, missing_extra, text

_MODELS = WarmModels()
"""Loaded checkpoints by path and device."""


class LeRobotPolicy:
    """Policy that loads a checkpoint and computes every action with it.

    Args:
        pretrained_name_or_path: a model on the Hugging Face hub, ``org/name``, or a local directory.
        device: a torch device; by default the checkpoint's own.

    Raises:
        ValidationError: no checkpoint.
        MissingExtraError: the [lerobot] extra is not installed.
    """

    uses_cameras = True

    def __init__(self, pretrained_name_or_path: str = "", device: str = "") -> None:
        try:
            import_module("lerobot")
        except ModuleNotFoundError as exc:
            raise missing_extra("The policy lerobot_local", "lerobot") from exc
        if not pretrained_name_or_path:
            raise ValidationError("pretrained_name_or_path must name a checkpoint, such as 'org/name', not ''.")
        self._checkpoint = text("pretrained_name_or_path", pretrained_name_or_path, longest=4096)
        self._device = text("device", device, longest=64, empty=True)
        self._instruction = ""
        self._keys: tuple[str, ...] = ()
        self._features: dict[str, Any] = {}
        self._loaded: tuple[Any, Any, Any] | None = None
        self._model: Any = None
        self._before: Any = None
        self._after: Any = None

    def warm(self) -> str | None:
        """Load the checkpoint on a thread; see :class:`Warmable`."""
        return _MODELS.warm((self._checkpoint, self._device), self._load)

    def _load(self) -> tuple[Any, Any, Any]:
        """Return model and processors; fetching them from the hub first takes minutes."""
        factory = import_module("lerobot.policies.factory")
        config = import_module("lerobot.configs.policies").PreTrainedConfig.from_pretrained(self._checkpoint)
        if self._device:
            config.device = self._device
        # Strictly: a weight that is missing would be a random one, with a line in the log.
        model = factory.get_policy_class(config.type).from_pretrained(self._checkpoint, config=config, strict=True)
        # A checkpoint that was saved on CUDA has processors that ask for it.
        on_device = {"device_processor": {"device": config.device}}
        before, after = factory.make_pre_post_processors(
            config, pretrained_path=self._checkpoint, preprocessor_overrides=on_device
        )
        return model, before, after

    def reset(self, instruction: str, ranges: Ranges) -> None:
        """Take the loaded checkpoint, or load it."""
        self._loaded = _MODELS.take((self._checkpoint, self._device), self._load)
        self._model, self._before, self._after = self._loaded
        for each in self._loaded:
            each.reset()
        self._instruction = instruction
        self._keys = tuple(ranges)
        self._features = {}

    def act(self, observation: Mapping[str, Any]) -> Action:
        utils = import_module("lerobot.policies.utils")
        if not self._features:
            self._features = self._dataset_features(observation)
        frame = utils.build_inference_frame(
            observation=dict(observation),
            ds_features=self._features,
            device=self._model.config.device,
            task=self._instruction,
        )
        with import_module("torch").inference_mode():
            tensor = self._after(self._model.select_action(self._before(frame)))
        action: Action = utils.make_robot_action(tensor, self._features)
        return action

    def interrupt(self) -> None:
        """Do nothing: a forward pass cannot be interrupted, and is short."""

    def close(self) -> None:
        self._model = self._before = self._after = None
        loaded, self._loaded = self._loaded, None
        if loaded is not None:
            _MODELS.give((self._checkpoint, self._device), loaded)

    def _dataset_features(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        convert = import_module("lerobot.datasets.utils").hw_to_dataset_features
        kinds = {key: tuple(value.shape) if getattr(value, "ndim", 0) else float for key, value in observation.items()}
        features: dict[str, Any] = {
            **convert(dict.fromkeys(self._keys, float), "action"),
            **convert(kinds, "observation"),
        }
        return features
