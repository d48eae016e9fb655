"""Parts of a body that the verbs of an arm need."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ArmParts:
    """Parts of an arm that a body has.

    Attributes:
        joints: some joint is moved to positions.
        model: where the tip is can be computed.
        tip: the tip can be moved to a point.
        jaws: a gripper opens and closes.
    """

    joints: bool = False
    model: bool = False
    tip: bool = False
    jaws: bool = False

    def verbs(self, *, sees: bool) -> frozenset[str]:
        """Return the names of the verbs that these parts carry out.

        Args:
            sees: objects are known, or a detector sees them.
        """
        places = self.joints and self.model
        needs = {
            "moveJoints": self.joints,
            "getPose": self.model,
            "goTo": places,
            "savePlace": places,
            "moveTo": self.tip,
            "moveBy": self.tip,
            "setGripper": self.jaws,
            "pick": self.tip and self.jaws,
            "place": self.tip and self.jaws,
            "getObjects": self.model and sees,
        }
        verbs = {name for name, has in needs.items() if has}
        return frozenset(verbs | {"wait"} if verbs - {"getPose", "getObjects"} else verbs)
