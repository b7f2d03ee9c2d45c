"""The Typer application and the parts that its commands share: console, progress, and cache of compiled programs.

Invalid input ends a command with one line on standard error and exit code 2. Progress is drawn as bars on a terminal,
otherwise printed as plain lines every few seconds. Compiled programs are kept in the user's cache directory, so that
only the first run of a command compiles; JAX_COMPILATION_CACHE_DIR takes precedence.
"""

import contextlib
import functools
import gc
import itertools
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager
from typing import Annotated, Any, NoReturn, TextIO

import typer
from rich import progress, table
from rich.console import Console, ConsoleOptions, RenderResult

from thor2_jax import __version__
from thor2_jax.errors import InputError, reason_of
from thor2_jax.printable import escape_characters
from training.storage.jobs import Progress, cache_directory, processor

__all__ = ["Table", "app", "console", "finish", "main", "option_arguments", "print_note", "show_help", "show_progress"]

MAX_BYTES = 2**30


def enable_compilation_cache() -> None:
    """Set the environment variables of JAX's compilation cache; set none if the directory is not writable.

    Raises:
        InputError: THOR2_CACHE names a file.
    """
    root = cache_directory("xla")
    if root is None or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    directory = root / processor()
    with contextlib.suppress(OSError):
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    if os.access(directory, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(directory)
        os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(MAX_BYTES))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        # After a damaged entry or on a full disk, the program is only compiled again.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")


SECONDS_PER_LINE = 5.0


def show_progress(quiet: bool = False, *, prints: bool = False) -> AbstractContextManager[Progress]:
    """Return a context whose callback shows the progress of each stage; with `quiet`, it shows nothing.

    A command that prints results meanwhile (`prints`) has no bars, since both would be on one line of the terminal.
    """
    if quiet:
        return contextlib.nullcontext(lambda stage, done, total, note: None)
    has_bars = not prints and sys.stderr.isatty() and not Console(stderr=True).is_dumb_terminal
    return _bars() if has_bars else contextlib.nullcontext(_lines())


@contextlib.contextmanager
def _bars() -> Iterator[Progress]:
    tasks: dict[str, progress.TaskID] = {}
    terminal = Console(stderr=True)
    # On a narrow terminal, the note is cut, then the bar, then the name, not the numbers.
    name_column = table.Column(no_wrap=True, max_width=max(terminal.width - 37, 1))
    name = progress.TextColumn("{task.description}", markup=False, table_column=name_column)
    note = progress.TextColumn("{task.fields[note]}", markup=False, table_column=table.Column(ratio=1, no_wrap=True))
    numbers = progress.MofNCompleteColumn(table_column=table.Column(no_wrap=True)), progress.TimeElapsedColumn()
    columns = name, progress.BarColumn(20), *numbers, progress.TimeRemainingColumn(), note
    with progress.Progress(*columns, console=terminal, expand=True) as bars:

        def show(stage: str, done: int, total: int, note: str) -> None:
            if stage not in tasks:
                # A live display is cut off at the height of the terminal, so the oldest stages are hidden.
                for task in bars.tasks[: max(0, len(bars.tasks) + 3 - bars.console.height)]:
                    bars.update(task.id, visible=False)
                # A resumed stage starts at the work already done, so that the remaining time is estimated correctly.
                tasks[stage] = bars.add_task(stage, total=total, completed=done, note=note)
            bars.update(tasks[stage], completed=done, total=total, note=note)

        yield show


def _lines() -> Progress:
    """Return a callback that prints a line when a stage begins, every few seconds while it runs, and when it ends."""
    begun: dict[str, tuple[float, int]] = {}
    printed, following = ("", 0), 0.0

    def show(stage: str, done: int, total: int, note: str) -> None:
        nonlocal printed, following
        now = time.monotonic()
        begins = stage not in begun
        start, first = begun.setdefault(stage, (now, done))
        if (stage, done) == printed or not (begins or done >= total or now >= following):
            return
        printed, following = (stage, done), now + SECONDS_PER_LINE
        elapsed = now - start
        parts = [f"{done:,} of {total:,}"]
        if elapsed >= 1:
            parts.append(f"{elapsed:.0f} s")
            if first < done < total:
                parts.append(f"about {elapsed * (total - done) / (done - first):.0f} s left")
        print(f"{stage}: {', '.join(filter(None, [*parts, note]))}", file=sys.stderr, flush=True)

    return show


app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Recognize objects on cluttered tables in RGB-D frames; synthetic views suffice for training (THOR2 in JAX).",
)
# A closed stream is None, and its file descriptor would go to the next file that is opened.
sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))


class _Console(Console):
    """A console that shows control characters in texts escaped, for instance those in names of folders.

    Text is broken into lines for terminals only, since programs read other output line by line.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        shown = [escape_characters(each) if isinstance(each, str) else each for each in objects]
        is_piped_text = not self.file.isatty() and all(isinstance(each, str) for each in objects)
        super().print(*shown, **{"soft_wrap": is_piped_text} | options)


# Without a terminal, rich would truncate tables at 80 columns. Below 72, it would leave out columns of tables, so
# tables are at least 72 wide, and the terminal breaks their lines. Names of objects may look like markup.
WIDTH = max(shutil.get_terminal_size().columns, 72) if sys.stdout.isatty() else 160
console = _Console(width=WIDTH, markup=False, emoji=False)


class Table(table.Table):
    """A table that folds words instead of cutting them, and has no padding if words fit only without it."""

    def __init__(self, *titles: str, title: str | None = None, folded: Collection[str] | None = None) -> None:
        """Create the table; the columns that are not in `folded` keep their width. By default, all may be folded."""
        fixed = () if folded is None else {*titles} - {*folded}
        super().__init__(*(table.Column(each, overflow="fold", no_wrap=each in fixed) for each in titles), title=title)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        excess = self.__rich_measure__(console, options.update(max_width=10_000)).minimum - options.max_width
        if 0 < excess <= 2 * len(self.columns):
            self.padding = 0
        return super().__rich_console__(console, options)


TRAINING_PACKAGES = ("colour", "embreex", "gudhi", "kmapper", "sklearn")
"""Packages that only training imports; recognition and the service do not need them (docs/install.md)."""

COLLECTION_THRESHOLD = 5_000
"""Number of new objects after which garbage is collected; with the default, 700, that takes an eighth of a command."""

MAY_BE_EMPTY = ("--baselines", "--leave-out", "--token")
"""Options whose value may be empty, or whose command checks the value itself."""


def option_arguments(**values: object) -> list[str]:
    """Return the command-line options with these values, in their order; None leaves an option out, True is a flag."""
    given = {f"--{name.replace('_', '-')}": value for name, value in values.items() if value is not None}
    return [word for name, value in given.items() for word in ([name] if value is True else [name, str(value)])]


def finish(result: str, purpose: str, *command: object, file: TextIO | None = None, **options: object) -> None:
    """Print where the result of a command is, and the most likely next command: `thor2`, its words and its options."""
    words = shlex.join(map(str, ("thor2", *command, *option_arguments(**options))))
    print(escape_characters(f"{result}; {purpose} with: {words}"), file=file, flush=True)


def print_note(text: str) -> None:
    """Print a line on standard error, beside the results of a command."""
    print(escape_characters(text), file=sys.stderr, flush=True)


def show_help(context: typer.Context) -> None:
    """Print the help of a command group if no command is given."""
    if context.invoked_subcommand is None:
        print(context.get_help(), end="")


@app.callback(invoke_without_command=True)
def thor2(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        print(f"thor2 {__version__}")
        raise typer.Exit
    show_help(context)


def _repeat_interrupt(report: Callable[[Any], Any], lost: Any, seconds: float = 0.01) -> None:
    """Send Ctrl-C again after some seconds if its exception was lost; pass other lost exceptions to `report`.

    Python ignores exceptions that are raised in finalizers and in callbacks of the garbage collector, including those
    of JAX. It only calls `sys.unraisablehook`.
    """
    if issubclass(lost.exc_type, KeyboardInterrupt):
        try:
            threading.Timer(seconds, os.kill, [os.getpid(), signal.SIGINT]).start()
        except KeyboardInterrupt:  # On a busy machine, the signal may arrive before this function ends.
            _repeat_interrupt(report, lost, 10 * seconds)
    else:
        report(lost)


def _interrupt(number: int, _: object) -> NoReturn:
    """Raise KeyboardInterrupt, so that files are finished or removed; a second signal ends the process at once."""
    signal.signal(number, signal.SIG_DFL)
    raise KeyboardInterrupt


def main() -> None:
    """Run the command line (entry point of the console script)."""
    caught = [each for each in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(each) is signal.SIG_DFL]
    previous = {number: signal.signal(number, _interrupt) for number in caught}  # `nohup` ignores SIGHUP
    report = sys.unraisablehook
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # as standard error, for names that its encoding lacks
    sys.unraisablehook = functools.partial(_repeat_interrupt, report)
    try:
        _check_not_empty(sys.argv[1:])
        home = os.path.expanduser("~/")  # many shells do not replace it in --out=~/x
        sys.argv = [re.sub("^(--[a-z-]+=)~/", lambda m: m[1] + home, each) for each in sys.argv]
        # If a signal ends this process, the process that then removes the semaphores of its workers would warn of them.
        sys.warnoptions.append("ignore:resource_tracker")
        enable_compilation_cache()
        if 0 < gc.get_threshold()[0] < COLLECTION_THRESHOLD:  # tests set a higher one
            gc.set_threshold(COLLECTION_THRESHOLD)
        status = app(standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        advice = f"; see {context.command_path} --help" if context else ""
        _exit_with(error.format_message().rstrip(".") + _given_value(error) + advice)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in TRAINING_PACKAGES:
            raise
        _exit_with(f"{package} is not installed; this command needs it, recognition does not: see docs/install.md")
    except (AssertionError, InputError, OSError, RuntimeError) as error:
        _check_platforms()
        if not isinstance(error, (InputError, OSError)) and "Symlink loop" not in str(error):  # of Path.resolve
            raise
        _exit_with(_with_options(reason_of(error)))
    finally:
        sys.unraisablehook = report
        for number, handler in previous.items():
            if signal.signal(number, handler) is signal.SIG_DFL:
                signal.raise_signal(number)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # Python would show an exception during its exit
    raise SystemExit(status)


def _check_platforms() -> None:
    """End this process if JAX cannot start with JAX_PLATFORMS, which seems to damage whatever file is read first."""
    if (platforms := os.environ.get("JAX_PLATFORMS")) and "jax" in sys.modules:
        try:
            sys.modules["jax"].devices()
        except Exception as error:
            _exit_with(f"JAX_PLATFORMS is {platforms} ({reason_of(error)}); expected one of this machine, such as cpu")


def _with_options(message: str) -> str:
    """Return a message with the given options in place of the arguments that they set: --max-gap, not max_gap.

    Each argument is replaced once, and the word after "argument: " is its value, such as a path. A word before a file
    of a frame is the name of that frame: "color: --labels: ..." is about the labels of color.png.
    """
    options = {argument.split("=")[0] for argument in sys.argv if argument.startswith("--")}
    names = {option[2:].replace("-", "_"): option for option in options}
    names |= {"segmenter": "--segment"} if "--segment" in options else {}
    word = rf"({'|'.join(map(re.escape, names))})(?=:? )(?!: (?:color|depth|labels|intrinsics):? )"
    replaced = re.sub(rf"(^| and |: ){word}((?:: [^\s:]+)?)", lambda m: m[1] + names.pop(m[2], m[2]) + m[3], message)
    return re.sub(r"(add views to it|replace it) \((extend|replace)\)", r"\1 (--\2)", replaced)


def _check_not_empty(arguments: list[str]) -> None:
    """Raise InputError for an empty argument, since an empty path would mean the current directory."""
    for previous, argument in itertools.pairwise(["the first argument", *arguments]):
        option, value = argument.split("=", 1) if re.match("--[^=]+=", argument) else (previous, argument)
        if not value and option not in MAY_BE_EMPTY:
            place = option if option.startswith("--") else f"the argument after {previous}"
            raise InputError(f"{place} is empty; expected a value: is a variable of the shell not set?")


def _given_value(error: Exception) -> str:
    """Return the value given for the option that caused a usage error, as an addition to its message."""
    options = getattr(getattr(error, "param", None), "opts", [])
    split = [part for each in sys.argv for part in (each.split("=", 1) if each.startswith("--") else [each])]
    given = [argument for option, argument in itertools.pairwise(split) if option in options]
    return f" (given: {given[-1]})" if given else ""


def _exit_with(message: str) -> NoReturn:
    print_note(f"error: {InputError(message)}")
    raise SystemExit(2)
