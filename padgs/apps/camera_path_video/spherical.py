"""What tells players that a film is a panorama: Google's Spherical Video V1, a box of XML in the track of an .mp4.

An .mp4 is a tree of boxes, each 4 bytes of size, 4 of type, and content. The box goes to the end of the track, which
moves nothing that is addressed by position, as long as the index (`moov`) is the last box of the file.
"""

from __future__ import annotations

import struct
from pathlib import Path
from uuid import UUID

SPHERICAL = UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
    "<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:ProjectionType>equirectangular</GSpherical:"
    "ProjectionType><GSpherical:StitchingSoftware>padgs</GSpherical:StitchingSoftware></rdf:SphericalVideo>"
)


def mark_spherical(film: Path) -> None:
    """Mark an .mp4 of one track as an equirectangular panorama, in place.

    Raises:
        ValueError: its last box is not the index, or the index has no track.
    """
    with film.open("r+b") as file:
        found = (b"", 0, 0)
        end = file.seek(0, 2)
        start = 0
        while start < end:
            file.seek(start)
            size, kind = struct.unpack(">I4s", file.read(8))
            if size == 1:  # 64 bits of it follow
                (size,) = struct.unpack(">Q", file.read(8))
            found, start = (kind, start, size), start + (size or end - start)
        kind, start, size = found
        if kind != b"moov":
            raise ValueError(f"{film} ends with a box {kind.decode('latin1')!r}; it must be the index, moov")
        file.seek(start)
        index = file.read(size)
        file.seek(start)
        file.write(_with_box(index))


def _with_box(index: bytes) -> bytes:
    """The index with the box at the end of its first track."""
    position = 8
    while position < len(index):
        size, kind = struct.unpack_from(">I4s", index, position)
        if kind == b"trak":
            content = SPHERICAL + XML.encode()
            box = struct.pack(">I4s", 8 + len(content), b"uuid") + content
            track = struct.pack(">I", size + len(box)) + index[position + 4 : position + size] + box
            whole = index[4:position] + track + index[position + size :]
            return struct.pack(">I", len(whole) + 4) + whole
        position += size
    raise ValueError("the film has no track")
