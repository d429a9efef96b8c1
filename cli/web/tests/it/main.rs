//! The server as browsers and attackers see it: requests over TCP, a farm in memory, and a small
//! data set on disk.

mod access;
mod actions;
mod client;
mod farm;
mod hostile;
mod models;
mod room;
mod scenes;
mod tls;
