"""A stand-in for tf2_msgs, which has no wheel: a `TFMessage` is the one transform that it was made of."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

TransformStamped.__class__.__import_type_support__()


class _AsTransform(type(TransformStamped)):  # type: ignore[misc]
    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, TransformStamped)


class TFMessage(TransformStamped, metaclass=_AsTransform):
    """A transform, sent as such."""

    def __new__(cls, transforms: list[TransformStamped]) -> Any:
        (only,) = transforms
        return only
