"""Recorder of drawing commands in this process, without a server: last value per property."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

Lowered = dict[str, Any]


class Recorder:
    """Window of a meshcat.Visualizer that remembers the scene, and forwards each command."""

    def __init__(self, forward: Callable[[bytes], None] | None = None) -> None:
        self.web_url = ""
        self._forward = forward
        # {path: {"set_object": ..., "set_transform": ..., "set_property visible": ...}}
        self._nodes: dict[str, dict[str, Lowered]] = {}
        self._animation: Lowered | None = None

    def send(self, command: Any) -> None:
        """Keep a meshcat command."""
        lowered = command.lower()
        kind, path = lowered["type"], lowered.get("path", "")
        # The browser makes nothing of empty parts of a path.
        path = "/" + "/".join(part for part in path.split("/") if part)
        if kind == "delete":
            below = path.rstrip("/") + "/"
            for other in [p for p in self._nodes if p == path or p.startswith(below)]:
                del self._nodes[other]
        elif kind == "set_animation":
            self._animation = lowered
        elif kind != "capture_image":
            key = f"{kind} {lowered.get('property', '')}"
            self._nodes.setdefault(path, {})[key] = lowered
        if self._forward:
            self._forward(_packed(lowered))

    def commands(self) -> Iterator[bytes]:
        """Yield the messages that build the scene anew, as meshcat's page takes them."""
        for node in list(self._nodes.values()):
            # An object replaces the one before it, so it comes ahead of what changes it.
            for key in sorted(node, key=lambda key: key != "set_object "):
                yield _packed(node[key])
        if self._animation:
            yield _packed(self._animation)

    def wait(self) -> None:
        """Do nothing: nobody has to connect."""

    def close(self) -> None:
        """Do nothing: there is nothing open."""


def _packed(lowered: Lowered) -> bytes:
    import umsgpack

    packed: bytes = umsgpack.packb(lowered)
    return packed
