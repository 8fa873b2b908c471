"""Colour profiles that photos embed, and their conversion to sRGB."""

from __future__ import annotations

import io

from PIL import Image, ImageCms


def foreign_profile(image: Image.Image) -> ImageCms.ImageCmsProfile | None:
    """The embedded colour profile. None for sRGB itself, because a conversion would only lose precision."""
    data = image.info.get("icc_profile")
    if not data:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        return None if "sRGB" in ImageCms.getProfileDescription(profile) else profile
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(f"its colour profile is broken ({error}); save it without one") from error


def to_srgb(mode: str, profile: ImageCms.ImageCmsProfile) -> ImageCms.ImageCmsTransform:
    """The conversion from the embedded profile to sRGB (relative colorimetric), 8-bit RGB."""
    space = profile.profile.xcolor_space.strip()  # pyright: ignore[reportAttributeAccessIssue] stubs lack it
    taken = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}.get(space)
    if taken is None or (taken == "CMYK") != (mode == "CMYK"):
        raise ValueError(f"its colour profile is for {space}, its pixels are {mode}; save it without one")
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    try:
        return ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), taken, "RGB", intent)
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(f"its colour profile is broken ({error}); save it without one") from error
