"""The metadata fields of image files, and how mi_ring treats each. `mi-ring convert` names fields that are not used."""

from pathlib import Path

import tifffile

from mi_ring.fields import Fields
from mi_ring.image_headers import (
    RAW,
    TIFF,
    exr_attributes,
    exr_channels,
    exr_picture,
    open_image,
    png_chunks,
    tiff_channels,
)

ANIMATED = "further pictures; the first is read"
TIFF_COLOURS = "WhitePoint PrimaryChromaticities TransferFunction"
#: By kind of file.
FIELDS = {
    "PNG": Fields(
        used={
            "IHDR PLTE IDAT IEND": "pixels", "tRNS": "alpha channel", "eXIf": "EXIF data",
            "cICP iCCP sRGB gAMA cHRM": "colours; the first of these counts",
        },
        told={"acTL fcTL fdAT": ANIMATED, "CgBI": "Apple's own variant"},
        harmless={
            "sBIT bKGD hIST sPLT mDC[Vv] cLL[Ii]": "how to show the picture",
            "tEXt zTXt iTXt tIME iDOT caNv orNT vpAg gIF*": "text, and notes of programs",
            "pHYs oFFs pCAL sCAL sTER": "its size on paper",
        },
    ),
    "JPEG": Fields(
        used={"APP1:Exif": "EXIF data", "APP2:ICC_PROFILE": "colours", "APP14:Adobe": "RGB or YCbCr"},
        harmless={
            "APP0:* APP1:http* APP1:* COM:* APP13:*": "text, previews and notes of programs",
            "APP2:* APP[3-9]:* APP1[0-25]:*": "further pictures, gain maps, data of the camera's maker",
        },
    ),
    "TIFF": Fields(
        used={
            "ImageWidth ImageLength BitsPerSample SampleFormat SamplesPerPixel PlanarConfiguration": "pixels",
            "Compression Predictor FillOrder JPEGTables T[46]Options": "pixels",
            "StripOffsets StripByteCounts RowsPerStrip Tile*": "pixels",
            "PhotometricInterpretation ColorMap YCbCr* ReferenceBlackWhite": "grey, RGB, palette or JPEG's YCbCr",
            "ExtraSamples": "alpha channel", "InterColorProfile": "colours", "Orientation ExifTag": "EXIF data",
        },
        refused={"PhotometricInterpretation=*": "CMYK, Lab, raw sensors", "page:2": "several pictures"},
        told={
            TIFF_COLOURS: "colours are read by the profile alone",
            "ExtraSamples=unspecified": "a channel that the file does not call alpha",
        },
        harmless={
            "NewSubfileType SubfileType SubIFDs PageN*": "previews",
            "XResolution YResolution ResolutionUnit XPosition YPosition": "its size on paper",
            "*SampleValue Threshholding GrayResponse* HalftoneHints": "how to show the picture",
            "Make Model Software Artist Copyright HostComputer DateTime* DocumentName ImageDescription XP* Rating*":
                "text",
            "XMP IPTC* Image* Photoshop* GPSTag Geo* Model* GDAL* IJMetadata* MicroManager* OME* Interop*":
                "notes of programs",
        },
    ),
    "OpenEXR": Fields(
        used={
            "channels": "pixels: R, G, B, A, of one layer, or Y, A, or the only channel",
            "dataWindow displayWindow compression lineOrder tiles type version chunkCount": "pixels",
            "chromaticities": "colours; without it sRGB's primaries",
        },
        refused={"dataWindow=*": "a part of the picture", "parts": "several pictures"},
        told={
            "channel:*": "other channels", "envmap": "a panorama",
            "*[cC]olor[sSI]* *[cC]olour* acesImage*": "colours are linear, with the primaries of chromaticities",
        },
        harmless={
            "expTime aperture isoSpeed": "pixels are radiance already", "pixelAspectRatio": "cameras have fx and fy",
            "worldTo* screenWindow*": "cameras come from the other tool",
            "*": "text, previews and notes of programs",
        },
    ),
    "WebP, AVIF, HEIF, BMP": Fields(
        used={"icc_profile* nclx_profile": "colours; in AVIF, too", "exif original_orientation": "EXIF data"},
        told={"duration": ANIMATED},
        harmless={
            "xmp metadata* thumbnails depth_images aux": "text, previews, other maps",
            "primary bit_depth chroma loop background timestamp compression dpi resolution": "the file",
            "jfif* adobe* transparency": "the file",
        },
    ),
    "raw": Fields(used={
        "mosaic black_level white_level camera_whitebalance rgb_xyz_matrix": "LibRaw develops to linear sRGB",
        "Exif": "EXIF data",
    }),
    "EXIF": Fields(
        used={
            "Orientation": "photos and Metashape's pictures that were turned", "ColorSpace InteropIndex": "Adobe RGB",
            "ExposureTime FNumber ISOSpeedRatings": "strength of the light",
            "FocalLengthIn35mmFilm Flash Model": "photos: first guess of the lens; photographs without flash; cameras",
        },
        harmless={
            "WhiteBalance Gamma ExposureBiasValue BrightnessValue": "in the pixels; a fit may refine gain and power",
            "*": "text, previews and data of the camera's maker",
        },
    ),
}  # fmt: skip


def field_names(path: Path) -> tuple[str, list[str]]:
    """Read the names of the metadata fields of an image file. Returns (kind of file, names).

    The kind is PNG, JPEG, TIFF, OpenEXR, raw, or one kind for WebP, AVIF, HEIF and BMP. Names of raw files are not
    read. Raises ValueError, InputError or another error if the file cannot be opened.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        attributes = dict(exr_attributes(path))
        channels = exr_channels(attributes[b"channels"])
        others = [name for name in channels if name not in exr_picture(channels)]
        return "OpenEXR", [*(name.decode("utf-8", "replace") for name in attributes), *map("channel:{}".format, others)]
    if suffix in TIFF:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            more = page.samplesperpixel > tiff_channels(page) and "ExtraSamples" in page.tags
            return "TIFF", [*(tag.name for tag in page.tags), *["ExtraSamples=unspecified"] * more]
    if suffix in RAW:
        return "raw", []
    with open_image(path) as image:
        if image.format == "PNG":
            return "PNG", [name.decode("latin-1") for name, _ in png_chunks(path)]
        if image.format in ("JPEG", "MPO"):
            segments = getattr(image, "applist", [])
            return "JPEG", [f"{place}:{own[:40].split(bytes(1))[0].decode('latin-1')}" for place, own in segments]
        return "WebP, AVIF, HEIF, BMP", [str(name) for name in image.info]


def unused_fields(path: Path) -> dict[str, str]:
    """Find metadata fields of an image file that mi_ring does not use although they may matter.

    Returns a dict from their names to the reason why each is not used, or "unknown". Raises ValueError, InputError or
    another error if the file cannot be opened.
    """
    kind, names = field_names(path)
    found = FIELDS[kind].unused(names)
    if kind == "TIFF" and "InterColorProfile" in names:
        return {name: why for name, why in found.items() if name not in TIFF_COLOURS}
    return found
