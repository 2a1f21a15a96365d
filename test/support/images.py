"""Images that somebody made to harm a reader."""

# Begins a scan of a JPEG.
SCAN = b"\xff\xda"


def many_scans(jpeg: bytes, number: int) -> bytes:
    """A JPEG whose last scan is repeated until it has this number of scans."""
    last, end = jpeg.rindex(SCAN), len(jpeg) - 2
    return jpeg[:end] + jpeg[last:end] * (number - jpeg.count(SCAN)) + jpeg[end:]
