"""What the diagnosis of a set-up finds."""

import dataclasses

__all__ = ["Diagnosis", "Finding"]


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something that is likely wrong.

    Attributes:
        code: short name of the problem, for machines: "depth-unit", "intrinsics-size", ...; docs/frames.md lists them.
        message: what was measured, and what it means, in plain words.
        advice: what to do.
    """

    code: str
    message: str
    advice: str


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        findings: what is likely wrong; empty for a sound set-up.
        notes: what could not be checked, and why.
    """

    findings: list[Finding] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def add(self, code: str, message: str, advice: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(code, message, advice))
