"""Sentences on the usual causes of innovations that contradict a filter's covariances."""

from typing import Any

import numpy as np

# Kurtosis above which only a few innovations are large; it is 3 for Gaussian numbers.
HEAVY = 8.0


def meaning(of: dict[str, Any], spoke: set[str], names: tuple[str, ...]) -> list[str]:
    """Sentences for an inconsistent verdict.

    Args:
        of: statistics of the run, as in `filter_verdict.py`.
        spoke: names of the tests that were significant.
        names: names of the measured components.
    """
    # a start that is like the rest is no sign of a wrong prior
    alike = bool(spoke & {"size", "sliding"}) and 0.5 < of["start"] / of["size"] < 2
    lines = _start(of) if "start" in spoke and not alike else []
    settled = spoke - {"start"}
    if not settled:
        return [*lines, f"From {of['settled']:.3g} s on nothing speaks against the filter."]
    part = (
        "No window of the first half has the NIS that is expected, so that the whole record is judged"
        if of["never"]
        else f"In the settled part, from {of['settled']:.3g} s on"
    )
    lines.append(f"{part}: {_size(of, settled)}")
    if "outliers" in settled and of["kurtosis"] > HEAVY:
        lines.append(
            f"The largest innovation is {of['largest']:.3g} times their root mean square: outliers. "
            "Take them out (NaN), or give R the size of what they do."
        )
        return lines
    lines.append(_cause(of, settled))
    if "bias" in settled:
        i = int(np.argmax(np.abs(of["means"])))
        which = names[i] if i < len(names) else f"component {i}"
        lines.append(
            f"The mean innovation of {which} is not zero: a bias of this sensor or of another, or a "
            "constant error of the model; add it as a state."
        )
    return lines


def _start(of: dict[str, Any]) -> list[str]:
    """Sentence about the prior."""
    wide = of["start"] < 1
    return [
        f"In the first {of['first']:.3g} s the NIS is {of['start']:.3g} per measured number where 1 is "
        f"expected: the prior is too {'wide' if wide else 'narrow'}, "
        + (
            "the start is nearer to the truth than it says."
            if wide
            else "the start is further from the truth than it says."
        )
    ]


def _size(of: dict[str, Any], spoke: set[str]) -> str:
    """Sentence about the NIS and the first window outside of its interval."""
    if not spoke & {"size", "sliding"}:
        return f"the NIS is as expected ({of['size']:.3g} of 1 per measured number)."
    words = f"the NIS is {of['size']:.3g} per measured number where 1 is expected"
    if not np.isnan(of["since"]):
        words += (
            f"; {of['high']:.0%} of the windows are too high and {of['low']:.0%} too low, the first at "
            f"{of['since']:.3g} s"
        )
    return words + "."


def _cause(of: dict[str, Any], spoke: set[str]) -> str:
    """Sentence about the cause, by the size and the correlation of the innovations."""
    size = "as large as" if not spoke & {"size", "sliding"} else (
        "smaller than" if of["size"] < 1 else "larger than"
    )  # fmt: skip
    sign = _correlation(of, spoke)
    told = {
        0: "and white",
        1: f"and successive ones are alike (correlation {of['memory']:+.2f}, means over windows "
        f"{of['slow drift']:.2g} times as large as chance makes them)",
        -1: f"and successive ones cancel (correlation {of['memory']:+.2f}, means over windows "
        f"{of['slow drift']:.2g} times as large as chance makes them)",
    }[sign]
    if size == "as large as" and not sign:
        return "Their sizes change along the record, or the noise is not Gaussian."
    return f"They are {size} the filter expects, {told}: {_MEANING[size, sign]}"


_MODEL = (
    "the filter lags behind, because the model is wrong (parameters, motion or a bias that it does "
    "not have) or Q is too small. Errors can be many of the stated deviations."
)
_MEANING = {
    (
        "smaller than",
        1,
    ): "R is too large, so that the filter follows too slowly and its lag hides below "
    "the noise that it assumes. Errors can be several of the stated deviations.",
    ("smaller than", 0): "R or Q is too large. The filter is too cautious; its errors are likely "
    "smaller than it says.",
    ("smaller than", -1): "Q is too large. The filter follows the noise; its errors are likely "
    "smaller than it says.",
    ("larger than", 1): _MODEL,
    ("larger than", 0): "R is too small.",
    (
        "larger than",
        -1,
    ): "R is too small, so that the filter follows the noise. Errors are larger than "
    "the stated deviations.",
    ("as large as", 1): _MODEL,
    (
        "as large as",
        -1,
    ): "Q is too large against R. The filter follows the noise; a smaller Q would "
    "make smaller errors.",
}


def _correlation(of: dict[str, Any], spoke: set[str]) -> int:
    """Sign of the correlation of successive innovations, zero if no test was significant."""
    for name in ("slow drift", "drift"):
        if name in spoke:
            return 1 if of[name] > 1 else -1
    if "memory" in spoke:
        return 1 if of["memory"] > 0 else -1
    return 0
