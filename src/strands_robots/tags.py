"""Tags of a robot: short words by which callers choose robots."""

from __future__ import annotations

from collections.abc import Collection

from strands_robots import settings
from strands_robots.utils import ValidationError, identifier, shown

TAGS_MAX = 16
TAG_MAX = 64
"""Tags of a robot, and letters of one."""


def own_tags(tags: Collection[str] | str | None) -> tuple[str, ...]:
    """Return the tags of a robot of this process, each once.

    Args:
        tags: as given, one or several; None asks ``STRANDS_TAGS``.

    Raises:
        ValidationError: one is no identifier of at most :data:`TAG_MAX` letters, or there are more than
            :data:`TAGS_MAX`.
    """
    stated: object = settings.items("STRANDS_TAGS") if tags is None else (tags,) if isinstance(tags, str) else tags
    if isinstance(stated, set | frozenset):
        stated = sorted(stated, key=str)
    if not isinstance(stated, list | tuple):
        raise ValidationError(f"tags must be a list of texts, not {shown(tags)}.")
    valid = tuple(dict.fromkeys(_tag(each) for each in stated))
    if len(valid) > TAGS_MAX:
        raise ValidationError(f"tags must be at most {TAGS_MAX}, not {len(valid)}.")
    return valid


def tags_of(tags: Collection[str] | str | None, *robots: object) -> tuple[str, ...]:
    """Return the tags as given, else as a robot states them, else the setting's.

    Raises:
        ValidationError: as :func:`own_tags`.
    """
    stated = (getattr(each, "tags", None) for each in robots)
    own = next((each for each in stated if isinstance(each, list | tuple | set | frozenset)), None)
    return own_tags(own if tags is None else tags)


def read_tags(stated: object) -> tuple[str, ...]:
    """Return the tags that another robot states; what is no tag is left out."""
    if not isinstance(stated, list | tuple):
        return ()
    found: dict[str, None] = {}
    for each in stated[:TAGS_MAX]:
        try:
            found[_tag(each)] = None
        except ValidationError:
            continue
    return tuple(found)


def _tag(value: object) -> str:
    named = identifier("tag", value)
    if len(named) > TAG_MAX:
        raise ValidationError(f"tag must have at most {TAG_MAX} letters, not {shown(value)}.")
    return named
