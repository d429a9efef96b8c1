//! Owners of jobs and the audit log, in Postgres. Audit entries are written outside of a
//! coordinator's life, because an entry from a fenced coordinator is also true.

use async_trait::async_trait;
use picofarm_proto::{ids::JobId, messages::AuditEntry};

use super::{PostgresCatalog, rights_query};
use picofarm_catalog::{AuditQuery, CatalogError, NewAudit, OwnedPlace, Owner, ResultSet, Rights};

#[async_trait]
impl Rights for PostgresCatalog {
    async fn owner(&self, job: JobId) -> Result<Option<Owner>, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::owner(&mut c, job)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn owned_near(&self, place: &str) -> Result<Vec<OwnedPlace>, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::owned_near(&mut c, place)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn largest_stage(&self, set: &ResultSet, user: &str) -> Result<u64, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::largest_stage(&mut c, set, user)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn audit(&self, lines: &[NewAudit]) -> Result<(), CatalogError> {
        let mut c = self.reader().await?;
        rights_query::audit(&mut c, lines)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn audited(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::audited(&mut c, query)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn forget_audit(&self, before_ms: i64) -> Result<u64, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::forget_audit(&mut c, before_ms)
            .await
            .map_err(|e| self.failed(e))
    }
}
