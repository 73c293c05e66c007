"""Pictures as parts of the page: the smaller of two forms that show the same, and nothing is fetched."""

import io
from base64 import b64encode
from typing import NamedTuple
from urllib.parse import quote

from PIL import Image, ImageSequence

COLOURS = 64  # of a figure as pixels: its few colours and what lies between them at edges
SMALL = 30_000  # bytes of an SVG below which pixels are not tried
LOSSLESS = {"lossless": True, "quality": 80, "method": 4}
PLAIN = " '=:/;,()[]{}!*+-.~_?@$&"  # of an SVG, as they are in an address between double quotes
GIF = "image/gif"
UNREADABLE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)  # what Pillow says of a damaged file


class Embedded(NamedTuple):
    """A picture as an address that holds it. size: of the picture in pixels, width and height."""

    address: str
    size: tuple[int, int]


def figure(svg: str, png: bytes) -> Embedded:
    """A figure from its two forms. An empty PNG, as tests write it, has no size.

    Pixels are taken where they are fewer bytes: thousands of points make a long SVG.
    """
    size = int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")  # of the PNG's header
    drawn = f"data:image/svg+xml,{quote(svg, PLAIN)}"
    if len(drawn) < SMALL or not any(size):
        return Embedded(drawn, size)
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    pixels = _address(_webp([few.convert("RGB")]), "image/webp")
    return Embedded(min(drawn, pixels, key=len), size)


def animation(gif: bytes) -> Embedded:
    """An animation, frame by frame the same as its GIF; the GIF itself where that is smaller or cannot be read."""
    size = int.from_bytes(gif[6:8], "little"), int.from_bytes(gif[8:10], "little")  # of the GIF's header
    plain = _address(gif, GIF)
    try:
        with Image.open(io.BytesIO(gif)) as image:
            frames = [
                (frame.convert("RGB"), frame.info.get("duration", 100)) for frame in ImageSequence.Iterator(image)
            ]
    except UNREADABLE:  # browsers are more patient
        return Embedded(plain, size)
    pictures, lasting = zip(*frames, strict=True)
    small = _address(_webp(list(pictures), list(lasting)), "image/webp")
    return Embedded(min(small, plain, key=len), size)


def _webp(frames: list[Image.Image], lasting: list[int] | None = None) -> bytes:
    """Pictures as WebP without loss. lasting: milliseconds of each, where there are several."""
    kept = io.BytesIO()
    moving = {"save_all": True, "append_images": frames[1:], "duration": lasting, "loop": 0} if lasting else {}
    frames[0].save(kept, "WEBP", **LOSSLESS, **moving)
    return kept.getvalue()


def _address(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(data).decode()}"
