//! A coordinator with callers of every kind, on SQLite or Postgres.

use std::path::PathBuf;

use picofarm_coordinator::{
    CoordinatorConfig, Running,
    auth::{Role, Tokens, Visibility},
    serve,
};
use picofarm_database::{CatalogPlace, testing};
use picofarm_proto::{
    spec::JobSpec,
    wire::{self, farm_client::FarmClient, jobs_client::JobsClient},
};
use tokio_util::sync::CancellationToken;
use tonic::{
    Code, Request, Status, metadata::MetadataValue, service::interceptor::InterceptedService,
    transport::Channel,
};

/// A caller, its role, and the projects in which it is a member and a maintainer.
pub const CALLERS: [(&str, Role, &str, &str); 7] = [
    ("ada", Role::Submit, "lidar", ""),
    ("bob", Role::Submit, "", ""),
    ("mia", Role::Submit, "lidar", ""),
    ("max", Role::Submit, "", "lidar"),
    ("vic", Role::View, "", ""),
    ("wes", Role::Work, "", ""),
    ("root", Role::Admin, "", ""),
];

type Bearer = Box<dyn FnMut(Request<()>) -> Result<Request<()>, Status> + Send + Sync>;
pub type Jobs = JobsClient<InterceptedService<Channel, Bearer>>;

pub struct Farm {
    _folder: tempfile::TempDir,
    pub tokens: PathBuf,
    secrets: Vec<(&'static str, String)>,
    channel: Channel,
    stop: CancellationToken,
    running: Running,
}

/// Returns the available catalogs: a new SQLite file, and a new Postgres database if a server is
/// given.
pub async fn catalogs(folder: &tempfile::TempDir) -> Vec<CatalogPlace> {
    let mut places = vec![CatalogPlace::from(folder.path().join("catalog.sqlite"))];
    if let Some(url) = testing::postgres().await {
        places.push(url.parse().unwrap());
    }
    places
}

/// Returns whether a coordinator restarted its life because the machine kept it from its catalog
/// for five seconds. It then reports that nothing was done.
pub fn begins_anew(code: Code) -> bool {
    code == Code::Unavailable
}

pub async fn again_soon() {
    tokio::time::sleep(std::time::Duration::from_millis(200)).await;
}

impl Farm {
    pub async fn start(catalog: CatalogPlace, visibility: Visibility) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.toml");
        let mut tokens = Tokens::default();
        let list = |project: &str| match project {
            "" => vec![],
            project => vec![project.to_owned()],
        };
        let secrets = CALLERS.map(|(name, role, member, maintainer)| {
            let made = tokens.create(name, vec![role].into(), list(member), list(maintainer));
            (name, made.unwrap().expose().to_owned())
        });
        tokens.write(&path).unwrap();
        let mut config = CoordinatorConfig::new(catalog, "127.0.0.1:0".parse().unwrap());
        config.access.tokens = Some(path.clone());
        config.access.visibility = visibility;
        let stop = CancellationToken::new();
        let running = serve(config, stop.clone()).await.unwrap();
        let url = format!("http://{}", running.address);
        Self {
            _folder: folder,
            tokens: path,
            secrets: secrets.to_vec(),
            channel: Channel::from_shared(url).unwrap().connect().await.unwrap(),
            stop,
            running,
        }
    }

    pub async fn stop(self) {
        self.stop.cancel();
        self.running.wait().await.unwrap();
    }

    fn bearer(&self, name: &str) -> Bearer {
        let (_, secret) = self.secrets.iter().find(|(n, _)| *n == name).unwrap();
        let value: MetadataValue<_> = format!("Bearer {secret}").parse().unwrap();
        Box::new(move |mut request| {
            request
                .metadata_mut()
                .insert("authorization", value.clone());
            Ok(request)
        })
    }

    pub fn jobs(&self, name: &str) -> Jobs {
        JobsClient::with_interceptor(self.channel.clone(), self.bearer(name))
    }

    /// Returns whether a caller may open a worker's session.
    pub async fn session(&self, name: &str) -> Code {
        let mut client = FarmClient::with_interceptor(self.channel.clone(), self.bearer(name));
        let answer = client.session(tokio_stream::empty()).await;
        answer.err().map_or(Code::Ok, |status| status.code())
    }

    pub async fn submit(
        &self,
        who: &str,
        spec: &JobSpec,
        again: bool,
    ) -> Result<Submitted, Status> {
        let request = wire::SubmitJobRequest {
            spec: Some(spec.clone().into()),
            again,
        };
        let mut jobs = self.jobs(who);
        let answer = loop {
            match jobs.submit_job(request.clone()).await {
                Err(status) if begins_anew(status.code()) => again_soon().await,
                answer => break answer?.into_inner(),
            }
        };
        Ok(Submitted {
            job: answer.job_id,
            existed: answer.existed,
        })
    }

    pub async fn audit(&self) -> Vec<wire::AuditEntry> {
        let request = wire::ListAuditRequest::default();
        let answer = self.jobs("root").list_audit(request).await.unwrap();
        let mut lines = answer.into_inner().entries;
        lines.reverse();
        lines
    }
}

#[derive(Debug)]
pub struct Submitted {
    pub job: String,
    pub existed: bool,
}

/// Returns a job with this name; `extra` contains further fields.
pub fn spec(name: &str, extra: &str) -> JobSpec {
    let text = format!(
        r#"{{"name": "{name}", {extra} "scenes": {{"kind": "primitive", "count": 2}},
            "render": {{"renderer": "r1"}},
            "output": {{"store": "file:///nowhere", "dataset": "{name}", "profile": "sqrt-u16"}}}}"#
    );
    serde_json::from_str(&text).unwrap()
}
