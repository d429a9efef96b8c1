-- Projects of jobs, and who did what. The log has no foreign key: it outlives the jobs.
ALTER TABLE job ADD COLUMN project TEXT NOT NULL DEFAULT '';

CREATE TABLE audit (
    sequence INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms    INTEGER NOT NULL,
    who      TEXT NOT NULL,
    act      TEXT NOT NULL,
    job      BLOB,
    outcome  TEXT NOT NULL,
    detail   TEXT NOT NULL
) STRICT;
CREATE INDEX audit_by_time ON audit (at_ms);
