//! Owners of jobs and the audit log, in SQLite.

use async_trait::async_trait;
use picofarm_proto::{ids::JobId, messages::AuditEntry};

use super::{SqliteCatalog, rights_query};
use picofarm_catalog::{AuditQuery, CatalogError, NewAudit, OwnedPlace, Owner, ResultSet, Rights};

#[async_trait]
impl Rights for SqliteCatalog {
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
        self.write(async |c, _| Ok(rights_query::audit(c, lines).await?))
            .await
    }

    async fn audited(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, CatalogError> {
        let mut c = self.reader().await?;
        rights_query::audited(&mut c, query)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn forget_audit(&self, before_ms: i64) -> Result<u64, CatalogError> {
        self.write(async |c, _| Ok(rights_query::forget_audit(c, before_ms).await?))
            .await
    }
}
