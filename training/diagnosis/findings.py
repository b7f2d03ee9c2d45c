"""Findings of the diagnosis of a set-up."""

import dataclasses

__all__ = ["Diagnosis", "Finding"]


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something that is likely wrong.

    Attributes:
        code: short name of the problem, for machines: "depth-unit", "intrinsics-size", ...; docs/frames.md lists them.
        message: the measurement and its meaning, in plain words.
        advice: remedy for the user.
    """

    code: str
    message: str
    advice: str


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        findings: likely mistakes; empty for a sound set-up.
        notes: checks that were not possible, and why.
    """

    findings: list[Finding] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def add(self, code: str, message: str, advice: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(code, message, advice))
