#!/usr/bin/env bash
# Checks the documentation: docs/check.sh; needs git and python3.
# Links and anchors lead somewhere; each page is in the contents; no placeholder is left; pages keep their limits; and
# each path of this repository that Markdown or a comment names exists.
set -euo pipefail
cd "$(dirname "$0")/.."
exec python3 - <<'PYTHON'
import pathlib, re, subprocess, sys

listed = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], capture_output=True, text=True, check=True)
files = sorted(f for f in set(listed.stdout.splitlines()) if pathlib.Path(f).exists())
pages = [pathlib.Path(f) for f in files if f.endswith(".md") and not f.startswith(".")]
# Every file and folder, and every end of their paths: docs may write `kinds/mod.rs` where the folder is clear.
whole = {"/".join(f.split("/")[:n]) for f in files for n in range(1, f.count("/") + 2)}
known = {"/".join(p.split("/")[n:]) for p in whole for n in range(p.count("/") + 1)}


def rooted(folder):
    """Returns the pattern of paths that begin with a folder of the repository or of `folder`."""
    inside = {f.split("/")[0] for f in files if "/" in f}
    inside |= {f.removeprefix(folder + "/").split("/")[0] for f in files if f.startswith(folder + "/") and "/" in f.removeprefix(folder + "/")}
    first = "|".join(sorted(re.escape(name) for name in inside if not name.startswith(".")))
    return re.compile(rf"(?<![\w./:-])(?:{first})/[\w./-]*\w(?![\w*<{{]|/[*<{{])")


ROOTED = rooted(".")
SOURCE = re.compile(r"`((?:[\w.-]+/)*[\w-]+\.(?:rs|sh|py|proto))`")


def prose(page):
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)


def anchors(page):
    heads = re.findall(r"^#+ +(.*)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in heads}


def missing(text, pattern=ROOTED):
    """Returns the paths in `text` that match `pattern`, or end as sources of this repository do, and do not exist."""
    return sorted({n for n in (*pattern.findall(text), *SOURCE.findall(text)) if n not in known})


wrong = []
for page in pages:
    wrong += [f"{page}: {mark}: nothing was put in its place" for mark in re.findall(r"@@\w+@@", page.read_text())]
    text = re.sub(r"`[^`\n]*`", "", prose(page))
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    links += re.findall(r"^\[[^\]]+\]: +(\S+)$", text, flags=re.M)
    for link in links:
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists():
            wrong.append(f"{page}: {link}: there is no such file")
        elif anchor and anchor not in anchors(target):
            wrong.append(f"{page}: {link}: the page has no such heading")
    code = "\n".join(re.findall(r"^```.*?^```|`[^`\n]*`", page.read_text(), flags=re.M | re.S))
    wrong += [f"{page}: {name}: there is no such file in the repository" for name in missing(code, rooted(str(page.parent)))]
for name in files:
    if not re.search(r"\.(rs|toml|sh|py|example|service|ya?ml)$|(^|/)(run|justfile)$", name):
        continue
    text = pathlib.Path(name).read_text()
    places = {n for n in ROOTED.findall(text) if re.search(r"\.(rs|md|py|sh|proto)$", n) and n not in known}
    if name.endswith(".rs"):
        comments = "\n".join(re.findall(r"^\s*//[/!]?\s?(.*)$", text, flags=re.M))
        places |= {n for n in missing(comments) if not n.endswith(".py")}  # comments cite programs of others
    wrong += [f"{name}: {place}: there is no such file in the repository" for place in sorted(places)]
contents = pathlib.Path("docs/SUMMARY.md").read_text()
for page in sorted(pathlib.Path("docs").glob("*.md")):
    if page.name != "SUMMARY.md" and f"({page.name})" not in contents:
        wrong.append(f"{page}: not in docs/SUMMARY.md")
for page in sorted(pathlib.Path("docs/decisions").glob("[0-9]*.md")):
    if f"(decisions/{page.name})" not in contents:
        wrong.append(f"{page}: not in docs/SUMMARY.md")
    words = len(page.read_text().split())
    if words > 180:
        wrong.append(f"{page}: {words} words; at most 180")
# Most columns of a table; and most words of a page without code. Generated pages have no limit of words.
COLUMNS = {"docs/laboratory.md": 7}
LIMITS = {"docs/benchmarks.md": 1600, "docs/calibration.md": 1300, "ARCHITECTURE.md": 1500, "CONTRIBUTING.md": 1300}
for page in (*pathlib.Path("docs").glob("*.md"), pathlib.Path("ARCHITECTURE.md"), pathlib.Path("CONTRIBUTING.md")):
    words = sum(bool(re.search(r"\w", word)) for word in prose(page).split())
    limit = LIMITS.get(str(page), 900)
    if page.name not in ("python-api.md", "reference.md") and words > limit:
        wrong.append(f"{page}: {words} words without code; at most {limit}: shorten it, or move a part to another page")
for page in pages:
    for line in prose(page).splitlines():
        if re.fullmatch(r"\|( *:?-+:? *\|)+", line) and line.count("|") - 1 > COLUMNS.get(str(page), 6):
            wrong.append(f"{page}: a table of {line.count('|') - 1} columns; at most {COLUMNS.get(str(page), 6)}")
lines = len(pathlib.Path("README.md").read_text().splitlines())
if lines > 120:
    wrong.append(f"README.md: {lines} lines; at most 120")
print("\n".join(wrong) or f"{len(pages)} pages and {len(files)} files: every link and path leads somewhere")
sys.exit(bool(wrong))
PYTHON
