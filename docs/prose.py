#!/usr/bin/env python3
"""Fails if comments or documentation use turns of phrase that make them hard to read.

docs/prose.py [--list]: counts phrases per 10,000 words of Rust comments and of Markdown, and exits
with 1 above a limit. With --list it prints each line that has one. Limits are about twice the
highest rate in HyperQueue, zarrs, nextest, uv and burn. CONTRIBUTING.md, "Review", has the rules.
"""

import pathlib
import re
import subprocess
import sys

# Phrase: the most per 10,000 words of comments. Documentation may have twice as many.
LIMITS = {
    "what is": 0.5, "that is": 14, "says": 0.8, "beside": 0.5, "holds": 4, "lies": 0.5,
    "so many": 0.5, "where there": 0.5, "whoever": 0.5, "whose": 6, "in place of": 1,
    "by way of": 0.5, "comes to": 0.6, "but for": 0.6, "anew": 0.5, "of which": 1.2, "meets": 0.6,
}  # fmt: skip
LONGEST = 100


def lines(path):
    """Yields line number and prose of a file: comments of Rust, Markdown without code."""
    fenced = False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if path.suffix == ".md":
            fenced ^= line.startswith("```")
            if not fenced:
                yield number, line
        elif comment := re.match(r"\s*//[/!]?\s?(.*)$", line):
            yield number, comment[1]


def main():
    names = subprocess.run(["git", "ls-files", "*.rs", "*.md"], capture_output=True, text=True, check=True)
    skip = ("CHANGELOG.md", "docs/reference.md")
    paths = [pathlib.Path(n) for n in names.stdout.split() if n not in skip and "generated" not in n]
    wrong = []
    for suffix, factor in ((".rs", 1), (".md", 2)):
        prose = [(p, n, text) for p in paths if p.suffix == suffix and p.exists() for n, text in lines(p)]
        clean = [(p, n, re.sub(r"`[^`]*`", "CODE", text).lower()) for p, n, text in prose]
        words = sum(len(text.split()) for _, _, text in clean)
        for phrase, limit in LIMITS.items():
            hits = [(p, n) for p, n, text in clean if re.search(rf"\b{phrase}\b", text)]
            rate = 1e4 * len(hits) / max(words, 1)
            if rate > limit * factor:
                wrong.append(f'"{phrase}" is {rate:.1f} times in 10,000 words of {suffix}; at most {limit * factor}')
            if "--list" in sys.argv:
                print("\n".join(f"{p}:{n}: {phrase}" for p, n in hits))
    for path in paths:
        if path.suffix == ".rs":
            for number, line in enumerate(path.read_text().splitlines(), 1):
                if re.match(r"\s*//", line) and len(line) > LONGEST and " " in line.strip()[4:]:
                    wrong.append(f"{path}:{number}: a comment of {len(line)} columns; at most {LONGEST}")
    print("\n".join(wrong) or f"{len(paths)} files: plain prose")
    sys.exit(bool(wrong))


main()
