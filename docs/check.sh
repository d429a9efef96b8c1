#!/usr/bin/env bash
# Checks that relative links and anchors in the documentation lead somewhere, that each page is in the contents, and that
# no placeholder is left:
# docs/check.sh; needs python3.
set -euo pipefail
cd "$(dirname "$0")/.."
exec python3 - <<'PYTHON'
import pathlib, re, sys

pages = [pathlib.Path(p) for p in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")]
pages += sorted(pathlib.Path("docs").rglob("*.md")) + sorted(pathlib.Path("deploy").rglob("*.md")) + [pathlib.Path("tests/peers/README.md")]

def prose(page):
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)

def anchors(page):
    heads = re.findall(r"^#+ +(.*)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in heads}

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
lines = len(pathlib.Path("README.md").read_text().splitlines())
if lines > 120:
    wrong.append(f"README.md: {lines} lines; at most 120")
print("\n".join(wrong) or f"{len(pages)} pages: every link leads somewhere")
sys.exit(bool(wrong))
PYTHON
