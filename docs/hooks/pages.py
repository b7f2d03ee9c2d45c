"""MkDocs hook: pages generated from the code, notebooks, and pages of the repository that lie outside of docs/.

The command line comes from the typer application, the HTTP interface from the FastAPI application. The page of a
notebook has the outputs that are stored in it.
"""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import typer
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.model.run_directory import TrainedRun, save_run
from training.cli.app import app

ROOT = Path(__file__).parents[2]

OUTSIDE = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "benchmarks/notes/accuracy.md",
    "benchmarks/notes/speed.md",
)
"""Pages outside of docs/; on the site they have the same paths below `repository/`."""


class _Examples(Preprocessor):
    """Fence the examples `>>> ...` of docstrings, which Markdown takes for quotations."""

    def run(self, lines: list[str]) -> list[str]:
        result, inside = [], False
        for line in lines:
            if line.startswith(">>>") and not inside:
                result, inside = [*result, "```python"], True
            elif inside and not line.strip():
                result, inside = [*result, "```"], False
            result.append(re.sub(r"\s*# doctest: \+SKIP$", "", line) if inside else line)
        return [*result, "```"] if inside else result


class _ExamplesExtension(Extension):
    def extendMarkdown(self, md: Any) -> None:  # noqa: N802
        """Register the preprocessor before that of fenced code (25)."""
        md.preprocessors.register(_Examples(md), "examples", 40)


def on_config(config: Any) -> None:
    """Add the Markdown extension."""
    config.markdown_extensions.append(_ExamplesExtension())


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages and those outside of docs/."""
    schema = openapi()
    pages = {
        "reference/command-line.md": command_line(),
        "reference/http.md": http_page(schema),
        "reference/openapi.json": json.dumps(schema, indent=1),
        **{f"repository/{name}": (ROOT / name).read_text(encoding="utf-8") for name in OUTSIDE},
        **notebook_pages(),
    }
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point links to notebooks, and between docs/ and the rest of the repository, to the pages of the site."""
    path = page.file.src_uri
    if path.startswith("repository/"):
        page.meta["search"] = {"exclude": "benchmarks" in path}  # measurements: found from the pages
        above = "../" * (path.count("/") - 1)
        markdown = markdown.replace(f"]({above}docs/", f"]({above}../")
        # Other files of the repository are not part of the site.
        return re.sub(r"\[([^\]]+)\]\((?!https?:)[^)#]+\.(?:py|json|toml|txt)\)", r"\1", markdown)
    above = "../" * (path.count("/") + 1)
    markdown = markdown.replace(".ipynb)", ".md)")
    for name in OUTSIDE:
        markdown = markdown.replace(f"]({above}{name}", f"]({above[3:]}repository/{name}")
    return markdown


def notebook_pages() -> dict[str, str | bytes]:
    """Return the pages of the notebooks and the pictures of their outputs: path in the site -> content."""
    pages: dict[str, str | bytes] = {}
    for path in sorted((ROOT / "docs").rglob("*.ipynb")):
        folder = path.parent.relative_to(ROOT / "docs").as_posix()
        body, resources = MarkdownExporter().from_filename(str(path))
        body = body.replace("![png](", f"![Output]({path.stem}_")
        heading, _, rest = body.lstrip().partition("\n")
        pages[f"{folder}/{path.stem}.md"] = f'{heading}\n\n<a href="{path.name}">This page as a notebook</a>\n{rest}'
        pages |= {f"{folder}/{path.stem}_{name}": content for name, content in resources["outputs"].items()}
    return pages


def command_line() -> str:
    """Return the page of all commands: usage, description, arguments and options."""
    lines = ["# Command line", "", "This page is generated from the code; `thor2 COMMAND --help` prints the same."]
    for path, command in commands():
        context = typer.Context(command, info_name=path)
        usage = " ".join(command.collect_usage_pieces(context))
        getattr(command, "insert_values", lambda: None)()
        lines += ["", f"## {path}", "", f"    {path} {usage}", "", _text(command.help or "")]
        rows = [_row(parameter, context) for parameter in command.params if parameter.name != "help"]
        if rows:
            lines += ["", "| argument or option | default | meaning |", "|---|---|---|", *rows]
    return "\n".join(lines) + "\n"


def commands(group: Any = None, path: str = "thor2") -> list[tuple[str, Any]]:
    """Return the paths and the command objects of all commands that are not groups."""
    group = group or typer.main.get_command(app)
    found: list[tuple[str, Any]] = []
    for name, command in sorted(group.commands.items()):
        inner = f"{path} {name}"
        found += commands(command, inner) if hasattr(command, "commands") else [(inner, command)]
    return found


def _row(parameter: Any, context: Any) -> str:
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts) if name.startswith("-"))
    shown = names or f"`{parameter.metavar or parameter.name.upper()}`"
    default = parameter.default
    unset = (
        default is None or default == [] or default is False or callable(default) or "Sentinel" in repr(type(default))
    )
    value = "required" if parameter.required else "" if unset else f"`{default}`"
    return f"| {shown} | {value} | {_text(getattr(parameter, 'help', '') or '')} |"


def _text(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")


def openapi() -> dict[str, Any]:
    """Return the OpenAPI description of a service with `--teach` and a token."""
    from thor2_jax.service.app import create_app
    from thor2_jax.service.settings import Settings

    with tempfile.TemporaryDirectory() as directory:
        run = Path(directory) / "run"
        save_run(TrainedRun(DescriptorConfig(), colornet.load_default(), (), {}, {}), run)
        return create_app(Settings(run, teach=True, token="...")).openapi()


def http_page(schema: dict[str, Any]) -> str:
    """Return the page of all requests with their form fields, of the statuses, and of the fields of all answers."""
    lines = [
        "# HTTP",
        "",
        "The requests of `thor2 serve --teach`, generated from the code. [openapi.json](openapi.json) describes them "
        "for programs; [the service](../service.md) explains them.",
    ]
    meanings: dict[str, str] = {}
    for path, methods in sorted(schema["paths"].items()):
        for method, operation in methods.items():
            lines += ["", f"## {method.upper()} {path}", "", operation.get("description", operation.get("summary", ""))]
            for kind, body in operation.get("requestBody", {}).get("content", {}).items():
                lines += ["", f"Body: `{kind}`", "", *_fields(body["schema"])]
            answers = operation["responses"]
            links = _links(answers.pop("200")) or "text"
            meanings |= {code: answer["description"] for code, answer in answers.items()}
            lines += ["", f"Answer: {links}. Errors: {', '.join(sorted(answers))}."]
    lines += ["", "## Statuses", "", "| status | meaning |", "|---|---|"]
    lines += [f"| {code} | {_text(meaning)} |" for code, meaning in sorted(meanings.items())]
    lines += ["", "## Fields of the answers", "", "An error has the fields of [Problem](#problem)."]
    for name, record in sorted(schema["components"]["schemas"].items()):
        lines += ["", f"### {name}", "", record.get("description", ""), "", *_fields(record)]
    return "\n".join(lines) + "\n"


def _fields(record: dict[str, Any]) -> list[str]:
    fields = record.get("properties", {})
    optional = {name: "" if name in record.get("required", ()) else " (optional)" for name in fields}
    return [
        f"- `{name}`{optional[name]}: {_text(field.get('description', ''))} {_links(field)}".rstrip(": ")
        for name, field in fields.items()
    ]


def _links(value: Any) -> str:
    """Return links to the records in a part of the OpenAPI description."""
    names = re.findall(r"#/components/schemas/(\w+)", json.dumps(value))
    return ", ".join(f"[{name}](#{name.lower()})" for name in names)
