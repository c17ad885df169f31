"""Files of pixels: decoded as they are stored, whatever an orientation tag says, and encoded again (pure)."""

import io
import tokenize

import numpy as np

from prior_sg.services.headers import ImageError, image_size, is_sized, trimmed
from prior_sg.services.opencv import cv2

NPY_MAGIC, EXR_MAGIC = b"\x93NUMPY", b"\x76\x2f\x31\x01"
BITS = {"uint8": 8, "int8": 8, "bool": 8}
DEPTH_MAX = 65535
NPY_FAULTS = (  # what numpy raises for damaged headers
    ValueError, TypeError, EOFError, OSError, SyntaxError, OverflowError, MemoryError, tokenize.TokenError,
)  # fmt: skip
JPEG_QUALITY = 95


def measured(data: bytes) -> tuple[int, int, int]:
    """Width, height and bits per channel of an image file or a saved array. Raises ImageError."""
    if is_sized(data):
        return image_size(data)
    pixels = stored(data)
    height_px, width_px = pixels.shape[:2]
    return width_px, height_px, BITS.get(pixels.dtype.name, 8 * pixels.dtype.itemsize)


def stored(data: bytes) -> np.ndarray:
    """Pixels (h, w) or (h, w, channels) as the file holds them (OpenCV's order of channels). Raises ImageError."""
    if data.startswith(NPY_MAGIC):
        return _array(data)
    if is_sized(data):
        data = trimmed(data)  # OpenCV would fill up an image that is cut off
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # empty, or a header that promises an absurd size
        image = None
    if image is None and data.startswith(EXR_MAGIC):
        raise ImageError("OpenCV cannot read OpenEXR here; convert it to .npy or .tiff in metres")
    if image is None:
        raise ImageError("it cannot be decoded" if is_sized(data) else "it is neither a PNG nor a JPEG file")
    return image


def _array(data: bytes) -> np.ndarray:
    array = array_of(data)
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if array.ndim not in (2, 3):
        raise ImageError(f"its array has the shape {array.shape}")
    return array


def array_of(data: bytes) -> np.ndarray:
    """Numbers of a saved array of any shape that holds some. Raises ImageError."""
    try:
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except NPY_FAULTS as error:
        raise ImageError("it is no saved array of numbers, or it is cut off: write it again with numpy.save") from error
    if 0 in array.shape or array.dtype.kind not in "fiub":
        raise ImageError(f"its array has the shape {array.shape} and the type {array.dtype}")
    return array


def eight_bit(data: bytes) -> np.ndarray:
    """Colour (h, w) or (h, w, 3) of 8 bits of an image file; 16 bits are rounded, transparency is left out.

    Raises ImageError.
    """
    image = stored(data)
    if image.dtype == np.uint16:
        image = np.rint(image / 257.0).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ImageError(f"it has values of type {image.dtype} instead of 8 or 16 bits")
    if image.ndim == 3 and image.shape[2] == 2:  # grey with transparency
        return image[..., 0]
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., :3])


def encoded(image: np.ndarray, extension: str) -> bytes:
    """An image file, .png or .jpg."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if extension == ".jpg" else []
    return cv2.imencode(extension, image, settings)[1].tobytes()


def millimetres(depth_m: np.ndarray) -> np.ndarray:
    """Depth (h, w), metres, as 16 bits of millimetres; what does not fit becomes 0, no measurement."""
    with np.errstate(invalid="ignore", over="ignore"):
        depth_mm = np.rint(np.asarray(depth_m, np.float64) * 1000.0)
    fits = np.isfinite(depth_mm) & (depth_mm > 0) & (depth_mm <= DEPTH_MAX)
    return np.where(fits, depth_mm, 0).astype(np.uint16)
