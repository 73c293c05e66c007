"""Pictures inside the page: the smaller form, and no pixel of an animation lost."""

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from reports.pages import embed

ROOT = Path(__file__).parents[3]
LIMIT = 3_000_000  # bytes of the page


def png(width: int = 60, height: int = 40) -> bytes:
    kept = io.BytesIO()
    Image.new("RGB", (width, height), "#0072B2").save(kept, "PNG")
    return kept.getvalue()


def opened(address: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2])))


def test_the_published_page_is_light() -> None:
    assert (ROOT / "results" / "paper" / "index.html").stat().st_size < LIMIT


def test_a_small_drawing_stays_a_drawing() -> None:
    found = embed.figure("<svg a='#b'>50 % \"x\"</svg>", png())
    assert found == ("data:image/svg+xml,%3Csvg a='%23b'%3E50 %25 %22x%22%3C/svg%3E", (60, 40))


def test_a_long_drawing_becomes_pixels_of_the_same_colour() -> None:
    found = embed.figure(f"<svg>{'<path/>' * 9999}</svg>", png())
    assert found.address.startswith("data:image/webp;base64,")
    assert found.size == (60, 40)
    assert opened(found.address).convert("RGB").getpixel((5, 5)) == (0, 0x72, 0xB2)
    assert embed.figure(f"<svg>{'<path/>' * 9999}</svg>", png()) == found


def test_pixels_that_are_more_bytes_are_left() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 3), dtype=np.uint8)
    kept = io.BytesIO()
    Image.fromarray(noise).save(kept, "PNG")
    found = embed.figure(f"<svg>{'<path/>' * 3000}</svg>", kept.getvalue())
    assert found.address.startswith("data:image/svg+xml,")


def gif(frames: int) -> bytes:
    kept = io.BytesIO()
    pictures = [Image.new("P", (200, 100), 0) for _ in range(frames)]
    for n, picture in enumerate(pictures):
        picture.putpalette([255, 255, 255, 0, 114, 178] + [0] * 750)
        picture.paste(1, (10 * n, 10, 10 * n + 30, 60))
    pictures[0].save(kept, "GIF", save_all=True, append_images=pictures[1:], duration=110, loop=0)
    return kept.getvalue()


def test_an_animation_is_the_same_frame_by_frame() -> None:
    data = gif(6)
    found = embed.animation(data)
    assert found.size == (200, 100)
    assert len(found.address) < len(base64.b64encode(data))
    before, after = (list(ImageSequence.Iterator(one)) for one in (Image.open(io.BytesIO(data)), opened(found.address)))
    assert len(before) == len(after) == 6
    for one, two in zip(before, after, strict=True):
        assert np.array_equal(np.asarray(one.convert("RGB")), np.asarray(two.convert("RGB")))
    assert after[1].info["duration"] == 110


def test_a_gif_that_claims_to_be_huge_is_left_as_it_is() -> None:
    data = gif(3)
    data = data[:6] + b"\xff\xff\xff\xff" + data[10:]
    assert embed.animation(data).address == f"data:image/gif;base64,{base64.b64encode(data).decode()}"


@pytest.mark.parametrize("cut", [30, 60])
def test_a_gif_that_cannot_be_read_is_left_as_it_is(cut: int) -> None:
    data = gif(3)[:cut] + b";"
    assert embed.animation(data).address == f"data:image/gif;base64,{base64.b64encode(data).decode()}"
