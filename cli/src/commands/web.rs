//! `picofarm web`: the farm, its data sets and light in flight in a browser. `up` serves the same
//! pages.

use std::{net::SocketAddr, sync::Arc};

use async_trait::async_trait;
use picofarm_proto::{
    ids::JobId,
    messages::{AuditEntry, Event, JobSummary},
    spec::JobSpec,
};
use picofarm_tasks::Access;
use picofarm_web::{
    Events, Explained, Farm, JobFilter, Refusal, Refused, Server, Settings as Shown, StartError,
    TlsFiles, Workers,
};
use serde_json::json;
use tokio::sync::Mutex;

use crate::{
    args::Web,
    client::{Client, Listing, Page},
    error::{CliError, Code, Result, io},
    output::Output,
    settings::Settings,
    signals,
};

/// How to reach the pages without opening them to others.
const TUNNEL: &str = "listen on 127.0.0.1 and use a tunnel (`ssh -L 7421:127.0.0.1:7421 HOST`)";

/// Serves the pages until a signal.
///
/// # Errors
/// Fails if the address is in use or reachable from elsewhere without a name, or if a store or the
/// access to the coordinator is not usable.
pub async fn run(args: Web, settings: &Settings, output: Output) -> Result<()> {
    for host in &args.host {
        if !picofarm_web::is_host(host) {
            return Err(CliError::input(format!(
                "--host {host}: expected a name or an address without a port"
            )));
        }
    }
    let farm = Coordinator::new(&settings.coordinator, settings.access()?);
    // Without a farm, the data sets are the first page.
    let alone = !args.store.is_empty() && farm.workers().await.is_err();
    let (first, name) = match alone {
        true => ("/data", "data sets"),
        false => ("/", "farm"),
    };
    let tls = args.tls_cert.zip(args.tls_key);
    let shown = Shown {
        listen: args.listen,
        hosts: args.host,
        tls: tls.map(|(certificate, key)| TlsFiles { certificate, key }),
        allow_insecure: args.allow_insecure,
        stores: args.store,
        farm: !alone,
    };
    let server = start(shown, farm).await?;
    for line in server.unread().await {
        output.warn(format!("--store {line}"));
    }
    let stop = signals::stop_on_signal()?;
    let link = server.link(first);
    let flight = server.first_flight().await.map(|path| server.link(&path));
    output.result(&json!({"web": link, "flight": flight}), || {
        let flight = flight.as_deref();
        let flight = flight.map_or(String::new(), |link| format!("\nlight in flight  {link}"));
        format!("{name:15}  {link}{flight}\nCtrl-C stops the server; a new start has a new link")
    });
    server.serve(stop).await;
    Ok(())
}

/// Starts to listen.
///
/// # Errors
/// Fails as [`Server::bind`] does.
pub async fn start(shown: Shown, farm: Coordinator) -> Result<Server> {
    Server::bind(shown, Arc::new(farm)).await.map_err(refused)
}

fn refused(error: StartError) -> CliError {
    match error {
        StartError::Listen(address, e) => {
            io(format!("cannot listen on {address}"), &e).hint("choose another --listen, e.g. 127.0.0.1:0 for any free port")
        }
        StartError::Open(address) => CliError::input(format!(
            "--listen {address}: other machines reach this address, and it has no name"
        ))
        .hint(format!("{TUNNEL}, or give --host NAME, --tls-cert and --tls-key")),
        StartError::Clear(address) => CliError::input(format!(
            "--listen {address}: other machines reach this address, and the pages are not encrypted"
        ))
        .hint(format!("{TUNNEL}, or give --tls-cert and --tls-key; --allow-insecure allows it where something else encrypts")),
        StartError::Certificate(e) => CliError::input(format!("--tls-cert, --tls-key: {e}")),
        StartError::Store(e) => CliError::input(format!("--store: {e}")),
    }
}

/// The coordinator, connected when it is first needed and again after it was away.
pub struct Coordinator {
    urls: String,
    access: Access,
    client: Mutex<Option<Client>>,
}

impl Coordinator {
    /// Names the coordinators, separated by commas, and the user's rights.
    pub fn new(urls: &str, access: Access) -> Self {
        Self {
            urls: urls.to_owned(),
            access,
            client: Mutex::default(),
        }
    }

    async fn call<T>(&self, ask: impl AsyncFnOnce(&mut Client) -> Result<T>) -> Result<T, Refusal> {
        let asked = async {
            let mut client = {
                let mut held = self.client.lock().await;
                match &*held {
                    Some(client) => client.clone(),
                    None => {
                        let fresh = Client::connect(&self.urls, &self.access).await?;
                        held.insert(fresh).clone()
                    }
                }
            };
            ask(&mut client).await
        };
        let answered = asked.await;
        if answered.as_ref().is_err_and(|e| kind(e) == Refused::Away) {
            *self.client.lock().await = None;
        }
        answered.map_err(|e| Refusal {
            kind: kind(&e),
            message: e.message,
            hint: e.hint,
        })
    }
}

/// Returns why the coordinator gave no answer.
fn kind(error: &CliError) -> Refused {
    use tonic::Code as Grpc;
    match error.status {
        _ if error.denied => Refused::Denied,
        Some(Grpc::NotFound) => Refused::Missing,
        Some(Grpc::FailedPrecondition) => Refused::NotNow,
        Some(Grpc::InvalidArgument | Grpc::OutOfRange) => Refused::Input,
        _ if error.code == Code::Coordinator => Refused::Away,
        _ => Refused::Failed,
    }
}

#[async_trait]
impl Farm for Coordinator {
    fn url(&self) -> String {
        crate::args::without_secrets(&self.urls)
    }

    async fn jobs(&self, filter: &JobFilter) -> Result<(Vec<JobSummary>, Option<String>), Refusal> {
        let given = |text: &'_ str| (!text.is_empty()).then(|| text.to_owned());
        let (page, user, find) = (
            given(&filter.page),
            given(&filter.user),
            given(&filter.find),
        );
        let (limit, state) = (filter.limit, filter.state);
        self.call(async |client: &mut Client| {
            let listing = Listing {
                limit,
                page: page.as_deref(),
                state,
                user: user.as_deref(),
                find: find.as_deref(),
            };
            client.list(&listing).await
        })
        .await
    }

    async fn spec(&self, job: JobId) -> Result<JobSpec, Refusal> {
        self.call(async |client: &mut Client| client.spec(job).await)
            .await
    }

    async fn events(&self, ask: Events) -> Result<Vec<Event>, Refusal> {
        let page = Page {
            job: ask.job,
            stage: None,
            task: None,
            after: ask.after,
            limit: ask.limit,
            newest: ask.newest,
            logs: ask.logs,
        };
        let events = self.call(async |client: &mut Client| client.history(page).await);
        Ok(events.await?.0)
    }

    async fn explain(&self, job: JobId, task: Option<(u32, u64)>) -> Result<Explained, Refusal> {
        let (stage, index) = task.map_or((0, None), |(stage, task)| (stage, Some(task)));
        let told = self.call(async |client: &mut Client| client.explain(job, stage, index).await);
        let told = told.await?;
        Ok(Explained {
            job: told.job,
            reasons: told.reasons,
            task: told.task,
            may_change: told.may_change,
        })
    }

    async fn workers(&self) -> Result<Workers, Refusal> {
        let all = self.call(async |client: &mut Client| client.workers().await);
        let all = all.await?;
        Ok(Workers {
            coordinator: all.coordinator,
            workers: all.workers,
            elsewhere: all.elsewhere,
        })
    }

    async fn audit(&self, before: Option<u64>, limit: u32) -> Result<Vec<AuditEntry>, Refusal> {
        self.call(async |client: &mut Client| client.audit(before, limit, None, None).await)
            .await
    }

    async fn cancel(&self, job: JobId) -> Result<(), Refusal> {
        self.call(async |client: &mut Client| client.cancel(job).await.map(drop))
            .await
    }

    async fn pause(&self, job: JobId, paused: bool) -> Result<(), Refusal> {
        self.call(async |client: &mut Client| client.pause(job, paused).await.map(drop))
            .await
    }

    async fn retry(&self, job: JobId) -> Result<(), Refusal> {
        self.call(async |client: &mut Client| client.retry(job).await.map(drop))
            .await
    }
}

/// Starts the pages of `up`: at its usual address, or at a free port if that is in use.
///
/// # Errors
/// Fails if no address can be used.
pub async fn start_for_up(store: String, farm: Coordinator) -> Result<Server> {
    let usual: SocketAddr = crate::args::WEB.parse().expect("a constant address");
    let farm = Arc::new(farm);
    let bind = async |listen| {
        let shown = Shown {
            listen,
            hosts: Vec::new(),
            tls: None,
            allow_insecure: false,
            stores: vec![store.clone()],
            farm: true,
        };
        Server::bind(shown, farm.clone()).await
    };
    // Asking first whether the address is free would leave time for another program to take it.
    let bound = match bind(usual).await {
        Err(StartError::Listen(..)) => bind(SocketAddr::new(usual.ip(), 0)).await,
        bound => bound,
    };
    bound.map_err(refused)
}
