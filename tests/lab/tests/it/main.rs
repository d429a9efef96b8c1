//! Tests of the benchmarks, in one executable because each one links the whole program.

mod render;
