"""Changes that make unusual tissue, light or cameras of a picture from inside of the body. Each takes a picture and a generator."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Change = Callable[[Image, np.random.Generator], Image]


def _bytes(picture: NDArray[np.floating]) -> Image:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def gains(*factors: float) -> Change:
    """Another gain for red, green and blue."""
    return lambda image, rng: _bytes(image * np.array(factors))


def hue(degrees: int) -> Change:
    """Rotate all hues."""

    def change(image: Image, rng: np.random.Generator) -> Image:
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        hsv[..., 0] = (hsv[..., 0].astype(int) + degrees // 2) % 180
        return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8)

    return change


def saturation(factor: float) -> Change:
    """Colours nearer to grey."""
    return lambda image, rng: _bytes(factor * image + (1 - factor) * _grey(image))


def softened(image: Image, rng: np.random.Generator, widths: float = 160) -> Image:
    """Out of focus: Gaussian blur of this share of the longer side."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), max(image.shape) / widths), np.uint8)


def _grey(image: Image) -> NDArray[np.float32]:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None].astype(np.float32)


def _mixed(image: Image, share: float, *colour: int) -> Image:
    """A veil of one colour over what is lit."""
    lit = (image.max(-1) > 25)[..., None]
    return np.where(lit, _bytes((1 - share) * image + share * np.array(colour)), image)


def pale(image: Image, rng: np.random.Generator) -> Image:
    """Ischaemic or fibrous tissue: nearly one pale yellow, under the same light."""
    light = image.max(-1, keepdims=True) / 255.0
    return _bytes(0.5 * image + 0.5 * light * np.array([235, 225, 190]))


def narrow_band(image: Image, rng: np.random.Generator) -> Image:
    """Narrow-band imaging: green light shown as red, blue light as green and blue."""
    return _bytes(np.stack([1.2 * image[..., 1], 1.4 * image[..., 2], 1.4 * image[..., 2]], -1))


def narrow_band_green(image: Image, rng: np.random.Generator) -> Image:
    """Narrow-band imaging as some cameras show it: greenish mucosa."""
    red, green = image[..., 0].astype(np.float32), image[..., 1].astype(np.float32)
    return _bytes(np.stack([0.55 * red, 1.15 * green, 0.9 * green], -1))


def _patches(image: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    coarse = cv2.resize(rng.random((4, 5)).astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(4 * (coarse - 0.35), 0, 0.8)[..., None]


def stained(*colour: int) -> Change:
    """Dye on a part of the tissue."""

    def change(image: Image, rng: np.random.Generator) -> Image:
        share = _patches(image, rng)
        return _bytes((1 - share) * image + share * image.mean(-1, keepdims=True) / 128 * np.array(colour))

    return change


def fluorescence(image: Image, rng: np.random.Generator) -> Image:
    """Indocyanine green: grey tissue with green where the dye is."""
    share, grey = _patches(image, rng), 0.7 * _grey(image)
    return _bytes((1 - share) * grey + share * grey * np.array([0.2, 1.8, 0.3]))


def smoke(image: Image, rng: np.random.Generator) -> Image:
    """Grey smoke in front of everything, lit by the scope as the tissue is."""
    light = cv2.GaussianBlur(image.max(-1), (0, 0), max(image.shape) / 12)[..., None].astype(np.float32)
    return _bytes(0.55 * image + 0.45 * 200 * np.minimum(1, light / np.percentile(light, 90)))


def particles(image: Image, rng: np.random.Generator) -> Image:
    """Bright particles that float in front of the tissue, and a little blur."""
    picture = image.copy()
    height, width = image.shape[:2]
    for _ in range(60):
        at = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(picture, at, int(rng.integers(1, max(2, width // 60))), (235, 230, 205), -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), max(width / 320, 0.5)), np.uint8)


def bleached(image: Image, rng: np.random.Generator) -> Image:
    """Overexpose the middle, as in a picture taken close to the tissue."""
    return _bytes(image * (1 + 3 * _middle(image, 0.45)))


def _middle(image: Image, radius: float) -> NDArray[np.float64]:
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    distance = ((x - width / 2) / (radius * width)) ** 2 + ((y - height / 2) / (radius * height)) ** 2
    return np.asarray(np.exp(-distance))[..., None]


def round_view(image: Image, rng: np.random.Generator) -> Image:
    """Black outside of a circle."""
    height, width = image.shape[:2]
    view = np.zeros((height, width, 1), np.uint8)
    cv2.circle(view, (width // 2, height // 2), int(0.48 * min(height, width)), 1, -1)
    return image * view


def fetoscopy(image: Image, rng: np.random.Generator) -> Image:
    """Pale yellow, soft, lit in the middle only, with particles, in a round view."""
    soft = cv2.GaussianBlur(image, (0, 0), max(image.shape) / 100)
    lit = (0.35 * soft + 0.52 * np.array([205, 190, 130])) * 1.2 * _middle(image, 0.45)
    return round_view(particles(_bytes(lit), rng), rng)


UNUSUAL: dict[str, Change] = {
    "unchanged": lambda image, rng: image,
    "yellow": gains(1.05, 1.05, 0.55),
    "green": gains(0.7, 1.15, 0.8),
    "blue": gains(0.7, 0.95, 1.35),
    "cold white": gains(0.8, 1.0, 1.2),
    "warm white": gains(1.15, 1.0, 0.8),
    "hue -40": hue(-40),
    "hue -20": hue(-20),
    "hue +20": hue(20),
    "hue +40": hue(40),
    "hue +60": hue(60),
    "half the colour": saturation(0.5),
    "little colour": saturation(0.2),
    "grey": saturation(0.0),
    "pale": pale,
    "dark": gains(0.35, 0.35, 0.35),
    "very dark": gains(0.15, 0.15, 0.15),
    "bright": gains(1.8, 1.8, 1.8),
    "bleached": bleached,
    "narrow band": narrow_band,
    "narrow band green": narrow_band_green,
    "blue dye": stained(40, 80, 190),
    "green dye": stained(40, 150, 110),
    "fluorescence": fluorescence,
    "fluid": lambda image, rng: _mixed(softened(image, rng), 0.4, 190, 160, 70),
    "smoke": smoke,
    "particles": particles,
    "soft": softened,
    "very soft": lambda image, rng: softened(image, rng, 80),
    "round view": round_view,
    "fetoscopy": fetoscopy,
}


def evened(image: NDArray[np.floating], share: float) -> NDArray[np.floating]:
    """Reduce the falloff of the light by this share."""
    light = cv2.GaussianBlur(image.max(-1).astype(np.float32), (0, 0), max(image.shape) / 10)[..., None] + 8
    return image * (light.mean() / light) ** share


def octagonal(image: Image, rng: np.random.Generator) -> Image:
    """Black outside of an octagon."""
    height, width = image.shape[:2]
    across, down = (
        np.abs(axis - side / 2) for axis, side in zip(np.ogrid[:height, :width][::-1], (width, height), strict=True)
    )
    inside = (across < 0.48 * width) & (down < 0.48 * height) & (across / width + down / height < 0.75)
    return image * inside[..., None].astype(np.uint8)


def arthroscopy(image: Image, rng: np.random.Generator) -> Image:
    """White cartilage: hardly any colour, bright, evenly lit, in a round view."""
    pale = saturation(0.12)(image, rng) * np.array([1.0, 0.99, 0.95])
    return round_view(_bytes(evened(255 * (pale / 255) ** 0.6, 0.5)), rng)


def arthroscopy_with_tools(image: Image, rng: np.random.Generator) -> Image:
    """White cartilage with two grey shafts."""
    picture, (height, width) = arthroscopy(image, rng), image.shape[:2]
    for left, grey in ((0.3, (120, 122, 128)), (0.55, (150, 152, 158))):
        shaft = np.array([[left, 1.0], [left + 0.2, 1.0], [left + 0.07, 0.45], [left - 0.03, 0.48]]) * [width, height]
        cv2.fillPoly(picture, [shaft.astype(int)], grey)
    return round_view(picture, rng)


def cystoscopy(image: Image, rng: np.random.Generator) -> Image:
    """Pale and soft, evenly lit, behind cloudy fluid, in a round view."""
    soft = softened(_bytes(evened(1.3 * saturation(0.45)(image, rng), 0.4)), rng)
    return round_view(_mixed(soft, 0.4, 200, 195, 170), rng)


def fogged(image: Image, rng: np.random.Generator) -> Image:
    """A fogged lens: very soft and grey."""
    return _bytes(0.4 * softened(image, rng, 40) + 0.6 * 190)


def lit_smoke(image: Image, rng: np.random.Generator) -> Image:
    """Smoke that hides nearly everything, lit in the middle by the scope."""
    return _bytes(0.15 * image + 0.85 * _middle(image, 0.5) * np.array([195, 197, 200]))


def compressed(image: Image, rng: np.random.Generator) -> Image:
    """A picture of very low quality, with blocks."""
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 5])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


HARD: dict[str, Change] = {
    "bleeding": lambda image, rng: _bytes(_grey(image) * np.array([1.1, 0.25, 0.22]) + np.array([40, 0, 0])),
    "bile": lambda image, rng: gains(0.8, 1.05, 0.45)(saturation(0.35)(image, rng), rng),
    "octagon": octagonal,
    "cystoscopy": cystoscopy,
    "arthroscopy": arthroscopy,
    "arthroscopy with tools": arthroscopy_with_tools,
    "fogged": fogged,
    "dense smoke": lambda image, rng: _bytes(0.2 * image + 0.8 * np.array([180, 182, 185])),
    "lit smoke": lit_smoke,
    "pale, overexposed": lambda image, rng: saturation(0.1)(gains(2.2, 2.2, 2.2)(image, rng), rng),
    "grey, evenly lit": lambda image, rng: _bytes(evened(_grey(image) * np.ones(3), 0.8)),
    "blue, evenly lit": lambda image, rng: _bytes(
        evened(saturation(0.25)(image, rng) * np.array([0.45, 0.75, 1.35]), 0.8)
    ),
    "compressed": compressed,
    "grey, compressed": lambda image, rng: compressed(saturation(0.0)(image, rng), rng),
}
"""Changes at the limit of what the gate can decide, for measurement. Some pictures changed so are withheld."""
HARD_TISSUE = ("bleeding", "bile", "octagon", "cystoscopy", "arthroscopy", "pale, overexposed", "compressed")
"""Those of which no whole picture is withheld."""
