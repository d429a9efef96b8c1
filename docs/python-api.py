#!/usr/bin/env python3
"""Writes docs/python-api.md from the docstrings of the Python package.

    docs/python-api.py            after every change of a public name or docstring
    docs/python-api.py --check    fails if the page is not up to date
"""

import ast
import inspect
import pathlib
import re
import sys

DOCS = pathlib.Path(__file__).parent
PACKAGE = DOCS.parent / "python" / "picofarm"
PAGE = DOCS / "python-api.md"
ALIASES = {
    target.id: ast.unparse(node.value)
    for path in sorted(PACKAGE.rglob("*.py"))
    for node in ast.parse(path.read_text()).body
    if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value
    for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
    if isinstance(target, ast.Name) and target.id.startswith("_")
}
HEADINGS = ("Args", "Returns", "Raises", "Yields", "Attributes")


def public(module):
    """Returns the names of `__all__`, and the module that defines each."""
    tree = ast.parse((module / "__init__.py").read_text())
    names, homes = [], {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            homes |= {name.asname or name.name: node.module for name in node.names}
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            names = ast.literal_eval(node.value)
    definitions = {}
    for home in sorted(set(homes.values())):
        path = module / f"{home}.py"
        if path.exists():
            body = ast.parse(path.read_text()).body
            definitions |= {node.name: node for node in body if hasattr(node, "name")}
    own = {node.name: node for node in tree.body if hasattr(node, "name")}
    return {name: (definitions | own)[name] for name in names if name in definitions | own}


def text(node):
    """Returns a docstring as Markdown."""
    lines = inspect.cleandoc(ast.get_docstring(node, clean=False) or "").split("\n")
    out, listed, code = [], False, False
    for line in lines:
        if line.removesuffix(":") in HEADINGS and line.endswith(":"):
            out += [f"{line}", ""]
            listed = True
        elif listed and (entry := re.fullmatch(r"    (\*{0,2}\w[\w, *]*): (.*)", line)):
            out.append(f"- `{entry[1]}`: {entry[2]}")
        elif listed and line.startswith("    "):
            out.append(("  " if out[-1].startswith(("-", "  ")) else "") + line.strip())
        elif line.startswith("    ") and (code or not out or not out[-1]):
            out += [*([] if code else ["```python"]), line[4:]]
            code = True
            continue
        else:
            listed = listed and not line
            out.append(line)
        if code:
            out[-1:] = ["```", out[-1]]
            code = False
    return "\n".join(out + ["```"] * code).strip()


def signature(name, node, skip):
    arguments = node.args
    arguments.posonlyargs, arguments.args = arguments.posonlyargs, arguments.args[skip:]
    for k, default in enumerate(arguments.kw_defaults):
        if isinstance(default, ast.Name) and default.id in ALIASES:
            arguments.kw_defaults[k] = ast.Name(ALIASES[default.id])
    for argument in [*arguments.args, *arguments.kwonlyargs]:
        argument.annotation = argument.annotation and ast.Name(annotation(argument.annotation))
    returns = f" -> {annotation(node.returns)}" if node.returns else ""
    return f"{name}({ast.unparse(arguments)}){returns}"


def annotation(node):
    """Returns an annotation with the package's private names for types written out."""
    shown = ast.unparse(node)
    while found := next((n for n in re.findall(r"\b_[A-Z]\w*", shown) if n in ALIASES), None):
        shown = re.sub(rf"\b{found}\b", lambda _: ALIASES[found], shown)
    return shown


def decorators(node):
    return {ast.unparse(d) for d in node.decorator_list}


def callable_(name, node, skip, level):
    awaited = "await " if isinstance(node, ast.AsyncFunctionDef) else ""
    return f"{level} `{awaited}{signature(name, node, skip)}`\n\n{text(node)}\n"


def class_(name, node):
    functions = [n for n in node.body if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    start = next((f for f in functions if f.name == "__init__"), None)
    shown = signature(name, start, 1).removesuffix(" -> None") if start else name
    out = [f"## {name}\n", f"`{shown}`\n" if shown != name else "", text(node) + "\n"]
    values = []
    for i, field in enumerate(node.body):
        if isinstance(field, ast.AnnAssign) and not field.target.id.startswith("_"):
            after = node.body[i + 1] if i + 1 < len(node.body) else None
            said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            values.append((field.target.id, annotation(field.annotation), inspect.cleandoc(said)))
    own = [f for f in functions if not f.name.startswith("_") and ast.get_docstring(f)]
    for f in own:
        if decorators(f) & {"property", "functools.cached_property", "cached_property"}:
            values.append((f.name, annotation(f.returns), text(f)))
    joined = [f"- `{n}: {kind}`" + (f": {' '.join(said.split())}" if said else "") for n, kind, said in values]
    out += ["\n".join(joined) + "\n"] if values else []
    for f in own:
        if any("property" in d or "setter" in d or d == "overload" for d in decorators(f)):
            continue
        out.append(callable_(f"{name}.{f.name}" if "classmethod" in decorators(f) else f.name, f, 1, "###"))
    return [part for part in out if part]


def page():
    out = [
        "# Python reference\n",
        "This page is made by `docs/python-api.py` from the docstrings of the package. Do not edit it by hand. "
        "[Python](python.md) introduces the package.\n",
    ]
    for module, prefix in ((PACKAGE, "picofarm"), (PACKAGE / "torch", "picofarm.torch")):
        for name, node in public(module).items():
            if isinstance(node, ast.ClassDef):
                out += class_(f"{prefix}.{name}", node)
            else:
                out.append(callable_(f"{prefix}.{name}", node, 0, "##"))
    return "\n".join(out)


made = page()
if "--check" not in sys.argv:
    PAGE.write_text(made)
elif not PAGE.exists() or PAGE.read_text() != made:
    sys.exit("docs/python-api.md is not up to date: run docs/python-api.py")
