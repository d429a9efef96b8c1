//! Traces for an OpenTelemetry collector (`--otlp`). In addition to the URL, these OpenTelemetry
//! variables are respected: OTEL_EXPORTER_OTLP_HEADERS, OTEL_SERVICE_NAME,
//! OTEL_RESOURCE_ATTRIBUTES, OTEL_TRACES_SAMPLER(_ARG), OTEL_BSP_….

use std::time::Duration;

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig, WithTonicConfig};
use opentelemetry_sdk::{
    Resource,
    trace::{Sampler, SdkTracerProvider},
};
use picofarm_proto::trace::TARGET;
use tonic::transport::ClientTlsConfig;
use tracing_subscriber::{
    Layer,
    filter::{LevelFilter, Targets},
    registry::LookupSpan,
};

use crate::error::{CliError, Result};

/// Timeout for sending the last spans at the end.
const GOODBYE: Duration = Duration::from_secs(3);

/// Exports spans to a collector.
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// Starts exporting to `url`, as `service` unless OTEL_SERVICE_NAME overrides it. Must be
    /// called within the runtime. Does not check whether a collector answers.
    ///
    /// # Errors
    /// Fails if the URL or the sampling ratio cannot be used.
    pub fn start(url: &str, service: &'static str) -> Result<Self> {
        let mut exporter = SpanExporter::builder()
            .with_tonic()
            .with_endpoint(url)
            .with_timeout(GOODBYE);
        if url.starts_with("https:") {
            exporter = exporter.with_tls_config(ClientTlsConfig::new().with_enabled_roots());
        }
        let exporter = exporter.build().map_err(|e| {
            CliError::input(format!("--otlp: {e}"))
                .hint("give the URL of a collector's gRPC port, e.g. http://127.0.0.1:4317")
        })?;
        let mut resource = Resource::builder();
        if std::env::var_os("OTEL_SERVICE_NAME").is_none_or(|name| name.is_empty()) {
            resource = resource.with_service_name(service);
        }
        let mut provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_resource(resource.build());
        // A named sampler is handled by the library. Otherwise only the ratio matters.
        if std::env::var_os("OTEL_TRACES_SAMPLER").is_none() {
            let share = Sampler::TraceIdRatioBased(share()?);
            provider = provider.with_sampler(Sampler::ParentBased(Box::new(share)));
        }
        Ok(Self(provider.build()))
    }

    /// Returns the layer that exports spans with the target for traces.
    pub fn layer<S>(&self) -> impl Layer<S> + use<S>
    where
        S: tracing::Subscriber + for<'a> LookupSpan<'a>,
    {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("picofarm"))
            .with_filter(Targets::new().with_target(TARGET, LevelFilter::DEBUG))
    }

    /// Sends the remaining spans.
    pub fn end(self) {
        if let Err(error) = self.0.shutdown_with_timeout(GOODBYE) {
            tracing::warn!(%error, "the last traces may be lost");
        }
    }
}

/// Returns the sampling ratio.
fn share() -> Result<f64> {
    const VARIABLE: &str = "OTEL_TRACES_SAMPLER_ARG";
    match std::env::var(VARIABLE) {
        Ok(text) if !text.trim().is_empty() => {
            let share = text.trim().parse().ok();
            share
                .filter(|share| (0.0..=1.0).contains(share))
                .ok_or_else(|| {
                    CliError::input(format!("{VARIABLE}: {text:?} is not a number from 0 to 1"))
                })
        }
        _ => Ok(1.0),
    }
}
