//! Tests the error for an unreachable database.

use picofarm_database::PostgresCatalog;

#[tokio::test]
async fn a_port_that_refuses_is_not_called_an_overloaded_server() {
    // A port that was just released.
    let port = std::net::TcpListener::bind("127.0.0.1:0")
        .and_then(|listener| listener.local_addr())
        .unwrap()
        .port();
    let url = format!("postgres://nobody@127.0.0.1:{port}/farm?sslmode=disable");
    let error = PostgresCatalog::open(&url, "test").await.err().unwrap();
    let said = error.to_string();
    assert!(
        said.contains("refused") && said.contains("is it running"),
        "{said}"
    );
    assert!(!said.contains("overloaded"), "{said}");
}
