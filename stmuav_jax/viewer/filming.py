"""Film of the moving mechanism of a saved run, as GIF or MP4."""

import contextlib
import io
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float, UInt8

from ..checks.errors import SettingError
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..control.closed_loop import LoopRun
from ..dynamics.run import Run
from ..files.netcdf import FileError, write_atomically
from .content import check_viewable, finite_times
from .page import dataset_of
from .stage import Stage

# Browsers show a frame of a GIF for at least 0.02 s, and delays are hundredths of a second.
_FASTEST_GIF = 50.0
_FASTEST = 240.0
_SMALLEST, _LARGEST = 64, 4096

Times = Float[np.ndarray, " k"]
Progress = Callable[[float], None] | None
# Content of a film's file: of a stage, the times of the frames, and their rate.
Encoder = Callable[[Stage, Times, float | int, Progress], bytes]


def film(
    run: Run | LoopRun | xr.Dataset | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    fps: float | int = 25.0,
    size: Sequence[int] = (640, 480),
    span: Numbers | None = None,
    view: Numbers = (24.0, -53.0),
    speed: float | int = 1.0,
    progress: Progress = None,
) -> Path:
    """Film of the moving mechanism of a run, written atomically; return the file's path.

    Bodies have the shapes of the viewer's page. The projection is parallel; a machine whose way is
    more than three times its size is followed, and the ground grid moves below it. Frames show

        t_k = t_first + k speed / fps,   t_k <= t_last

    each for 1 / fps. In a GIF, whose delays are hundredths of a second, they are rounded so that no
    error adds up.

    Args:
        run: run or closed loop's run; or the dataset, file or folder of a saved one.
        path: file that ends with .gif or .mp4. MP4 needs ffmpeg, from the extra `film` or the PATH.
        fps: frames per second of the film [1/s], at most 240, in a GIF 50.
        size: width and height [pixels], even numbers for MP4.
        span: first and last time that is shown [s]; default all.
        view: elevation and azimuth of the eye [degrees].
        speed: seconds of the motion in a second of the film; 0.1 is slow motion.
        progress: called with the share that is done, from 0 to 1, after every frame.

    Raises:
        FileError: no saved run, one that lacks what is drawn, or ffmpeg fails.
        SettingError: another ending, a number out of its range, or MP4 without ffmpeg.
    """
    target = Path(path)
    encode = _encoder(target, fps, size)
    data = dataset_of(run)
    check_viewable(data)
    shown = _span(data["time"].values[finite_times(data)], span)
    eye = numbers(view, (2,), "The elevation and azimuth of the eye", "degrees", SettingError)
    if abs(float(eye[0])) > 90:
        raise SettingError(
            f"The elevation of the eye must lie within -90 and 90 degrees, but it is {float(eye[0]):g}."
        )
    times = frame_times(shown, fps, speed)
    caption = "" if speed == 1 else f"speed {speed:g}"
    stage = Stage(data, (size[0], size[1]), (float(eye[0]), float(eye[1])), shown, caption)
    return write_atomically(target, encode(stage, times, fps, progress))


def frame_times(span: tuple[float, float], fps: float | int, speed: float | int = 1.0) -> Times:
    """Times that the frames of a film show (k,) [s]; see `film`.

    Raises:
        SettingError: a rate or speed that is no positive number, or a film of a single frame.
    """
    for value, what, unit in ((fps, "number of frames per second", "1/s"), (speed, "speed", "1")):
        if not (math.isfinite(value) and value > 0):
            raise SettingError(
                f"The {what} of a film must be positive, but it is {value:g} {unit}."
            )
    first, last = span
    # the last time belongs to the film where it is a whole number of frames up to round-off
    count = math.floor((last - first) * fps / speed * (1 + 1e-12) + 1e-9) + 1
    if count < 2:
        raise SettingError(
            f"From {first:g} to {last:g} s there is one frame at {fps:g} frames per second and a speed of "
            f"{speed:g}; ask for more frames per second or a lower speed."
        )
    return first + np.arange(count) * speed / fps


def _span(ts: Times, span: Numbers | None) -> tuple[float, float]:
    start, end = float(ts[0]), float(ts[-1])
    if span is None:
        return start, end
    first, last = (
        float(t) for t in numbers(span, (2,), "The span of a film", "s", SettingError)
    )  # fmt: skip
    # saved times are decimal fractions only up to round-off
    slack = 1e-9 * max(abs(start), abs(end))
    if not (start - slack <= first < last <= end + slack):
        raise SettingError(
            f"The span of a film must be two times, the earlier first, within those of the run, {start:g} "
            f"to {end:g} s, but it is {first:g} to {last:g} s."
        )
    return max(first, start), min(last, end)


def _frames(stage: Stage, times: Times, progress: Progress) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for k, t in enumerate(times):
        stage.draw(float(t))
        yield stage.pixels()
        if progress is not None:
            progress((k + 1) / len(times))


def _encoder(path: Path, fps: float | int, size: Sequence[int]) -> Encoder:
    """Function that makes a file's content of frames; all that can be wrong is checked first."""
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise SettingError(
            f"A film is a file that ends with .gif or .mp4, but this one is '{path.name}'."
        )
    whole = all(isinstance(n, int | np.integer) and _SMALLEST <= n <= _LARGEST for n in size)
    if len(size) != 2 or not whole or (suffix == ".mp4" and any(n % 2 for n in size)):
        even = "even " if suffix == ".mp4" else ""
        raise SettingError(
            f"The size of the film must be two {even}whole numbers of pixels within {_SMALLEST} and "
            f"{_LARGEST}, but it is {tuple(size)}."
        )
    fastest = _FASTEST_GIF if suffix == ".gif" else _FASTEST
    if fps > fastest:
        raise SettingError(
            f"{path.name} can have at most {fastest:g} frames per second, but {fps:g} are asked for."
        )
    if suffix == ".gif":
        return _gif
    program = _ffmpeg()
    return lambda *given: _mp4(program, *given)


def _gif(stage: Stage, times: Times, fps: float | int, progress: Progress) -> bytes:
    """Content of a GIF file, all frames with one palette, so that no colour flickers."""
    from PIL import Image

    some = []
    for t in times[[0, len(times) // 2, -1]]:
        stage.draw(float(t))
        some.append(stage.pixels())
    plain = Image.Dither.NONE
    # one colour of 256 stays free: it stands for pixels that do not change
    # the default would spend its colours on shades of the ground, and give small parts other colours
    whole = Image.fromarray(np.concatenate(some))
    palette = whole.quantize(255, method=Image.Quantize.MAXCOVERAGE, dither=plain)
    pictures = (
        Image.fromarray(frame).quantize(palette=palette, dither=plain)
        for frame in _frames(stage, times, progress)
    )
    ends = np.round(100 * np.arange(len(times) + 1) / fps).astype(int)
    buffer = io.BytesIO()
    next(pictures).save(
        buffer, format="GIF", save_all=True, append_images=pictures, optimize=True, loop=0,
        duration=[10 * int(delay) for delay in np.diff(ends)],
    )  # fmt: skip
    return buffer.getvalue()


def _mp4(program: str, stage: Stage, times: Times, fps: float | int, progress: Progress) -> bytes:
    """Content of an MP4 file with H.264, which every browser plays."""
    with tempfile.TemporaryDirectory(prefix="stmuav-film-") as folder:
        target, said = Path(folder) / "film.mp4", Path(folder) / "errors.txt"
        command = [
            program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-s", f"{stage.size[0]}x{stage.size[1]}", "-r", f"{fps:.6g}", "-i", "-", "-an", "-c:v", "libx264",
            "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(target),
        ]  # fmt: skip
        with said.open("wb") as errors:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors
            )
            assert process.stdin is not None
            try:
                # a program that has ended takes no more frames; its message says why
                with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
                    for frame in _frames(stage, times, progress):
                        pipe.write(frame.tobytes())
                process.wait()
            except BaseException:
                process.kill()
                process.wait()
                raise
        if process.returncode != 0 or not target.is_file():
            words = " ".join(said.read_text(errors="replace").split())
            raise FileError(f"{program} could not write the film: {words[:500]}")
        return target.read_bytes()


def _ffmpeg() -> str:
    """Path of ffmpeg: of the package imageio-ffmpeg, or on the PATH."""
    with contextlib.suppress(ImportError, RuntimeError):
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

        return imageio_ffmpeg.get_ffmpeg_exe()
    found = shutil.which("ffmpeg")
    if found is None:
        raise SettingError(
            "An MP4 needs ffmpeg: pip install 'stmuav-jax[film]', or put ffmpeg on the PATH. A GIF needs "
            "neither."
        )
    return found
