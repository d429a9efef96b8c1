# Recipes for those who work on picofarm. `just` lists them.

_default:
    @just --list

# Run every test; installs what the tests need on Debian.
test *args:
    tests/run {{args}}

# Check format and lints, as continuous integration does.
lint:
    cargo fmt --all --check
    cargo clippy --workspace --all-targets --features picofarm/full,picofarm/wgpu --locked -- -D warnings
    cargo clippy --locked -- -D warnings

# Render rooms, verify them and draw pictures.
demo *args:
    cargo run --release -- demo {{args}}

# Run one of the benchmarks: `just lab render`; `just lab --help` lists them.
lab *args:
    cargo run --release -p picofarm-lab -- {{args}}

# Build the wheel of the Python package (needs `pip install maturin`).
wheel:
    maturin build --release --manifest-path python/Cargo.toml --out target/wheels

# Check links, regenerate the command reference, and build the book if mdbook is installed.
docs:
    cargo build --features full
    docs/reference.sh target/debug/picofarm
    docs/check.sh
    command -v mdbook >/dev/null && mdbook build docs || echo "mdbook is not installed; no book"
