"""ROS 2 message definitions as MCAP files carry them."""

from __future__ import annotations

from functools import cache

_SEPARATOR = "=" * 80
Definition = dict[str, tuple[tuple[str, str], ...]]


@cache
def schema_text(message_type: str) -> str:
    """Definition of a ROS 2 type with all it contains, as MCAP's ``ros2msg`` encoding wants it."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY).generate_msgdef(message_type, ros_version=2)[0]


def is_own_definition(message_type: str, text: bytes) -> bool:
    """Whether a file's definition of a type has ROS 2's own fields.

    Another one is not followed: it may ask for arrays of any length, of things that take no bytes.
    """
    from rosbags.typesys import Stores, get_typestore

    if message_type not in get_typestore(Stores.ROS2_JAZZY).types:
        return False
    return _fields(text.decode(errors="replace"), message_type) == _fields(
        schema_text(message_type), message_type
    )


def _fields(text: str, message_type: str) -> Definition:
    """(type, name) of the fields of every type in a definition; comments, constants and packages left out."""
    found: Definition = {}
    for k, block in enumerate(text.replace("\r", "").split(_SEPARATOR)):
        name, fields = message_type if k == 0 else "", []
        for line in block.splitlines():
            words = line.split("#")[0].split()
            if words and words[0] == "MSG:":
                name = words[-1]
            elif len(words) >= 2 and "=" not in "".join(words[1:]):
                fields.append((words[0].split("/")[-1], words[1]))
        found[name.split("/")[-1]] = tuple(fields)
    return found
