"""Runs notebooks and fails at the first error: run_notebooks.py NOTEBOOK...

With --save, it writes their outputs back, without animations and without the steps of progress bars.
"""

import argparse
import tempfile

import nbclient
import nbformat


def tidy(cell):
    """Keeps what a reader sees at the end: the last state of a bar, and no animation."""
    errors = [o for o in cell.outputs if o.output_type == "stream" and o.name == "stderr"]
    kept = [o for o in cell.outputs if o not in errors and "image/gif" not in o.get("data", {})]
    text = "".join(o.text for o in errors).rstrip("\n").split("\r")[-1]
    last = [nbformat.v4.new_output("stream", name="stderr", text=text + "\n")] if text else []
    cell.outputs = last + kept
    cell.metadata.pop("execution", None)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="+")
    parser.add_argument("--save", action="store_true")
    args = parser.parse_args()
    for name in args.notebooks:
        book = nbformat.read(name, 4)
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            nbclient.NotebookClient(book, timeout=900, resources=resources).execute()
        print(f"{name}: ran", flush=True)
        if args.save:
            for cell in book.cells:
                if cell.cell_type == "code":
                    tidy(cell)
            nbformat.write(book, name)


if __name__ == "__main__":
    main()
