"""What a file is by its first bytes, in words for an error message about a checkpoint that is none."""

from __future__ import annotations

_SIGNATURES: tuple[tuple[bytes, str], ...] = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: run `git lfs pull` where it came from"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"GIF8", "a GIF picture"),
    (b"%PDF", "a PDF document"),
    (b"\x1f\x8b", "a gzip file: unpack it first"),
    (b"BZh", "a bzip2 file: unpack it first"),
    (b"\xfd7zXZ", "an xz file: unpack it first"),
    (b"7z\xbc\xaf", "a 7-zip archive: unpack it first"),
    (b"Rar!", "a RAR archive: unpack it first"),
    (b"\x28\xb5\x2f\xfd", "a zstandard file: unpack it first"),
    (b"\x89HDF", "an HDF5 file, as Keras writes: convert the weights to .safetensors"),
    (b"\x93NUMPY", "a numpy array (.npy)"),
    (b"GGUF", "a GGUF file of llama.cpp"),
    (b"ply\n", "a PLY point cloud"),
    (b"PK\x05\x06", "an empty zip archive"),
    (b"RIFF", "a RIFF file (WebP, WAV or AVI)"),
)


def describe_kind(head: bytes, size: int) -> str | None:
    """What a file of `size` bytes is whose first kilobyte is `head`; None if that tells nothing.

    Example:
        >>> describe_kind(b"<!DOCTYPE html><html>", 21)
        'an HTML page: the download failed, most likely behind a login or a warning'
    """
    if size == 0:
        return "an empty file: the download failed"
    for signature, words in _SIGNATURES:
        if head.startswith(signature):
            return words
    if head[257:262] == b"ustar":
        return "a tar archive (torch before 0.2, or a packed folder): unpack it, or save its weights again"
    if not head.strip(b"\0"):
        return "a file of zeros: the download was interrupted"
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html", b"<head")):
        return "an HTML page: the download failed, most likely behind a login or a warning"
    if text.startswith(b"<?xml"):
        return "an XML document: the download failed, most likely (storage servers answer so)"
    return None


def describe_text(head: bytes) -> str | None:
    """What a file is whose first kilobyte is text; None if it is not text."""
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 3:  # not only the last character cut in two
            return None
        text = head[: error.start].decode("utf-8")
    if not all(char.isprintable() or char in "\t\n\r\f" for char in text):
        return None
    if text.lstrip().startswith(("{", "[")):
        return "a JSON file (settings, or the index of a checkpoint in several parts), not the weights"
    return f"a text file that begins {text.strip().splitlines()[0][:40]!r}" if text.strip() else "a blank text file"
