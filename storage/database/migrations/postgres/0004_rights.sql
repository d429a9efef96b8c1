-- Projects of jobs, and who did what. The log has no foreign key: it outlives the jobs.
ALTER TABLE job ADD COLUMN project TEXT NOT NULL DEFAULT '';

CREATE TABLE audit (
    sequence BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    at_ms    BIGINT NOT NULL,
    who      TEXT NOT NULL,
    act      TEXT NOT NULL,
    job      UUID,
    outcome  TEXT NOT NULL,
    detail   TEXT NOT NULL
);
CREATE INDEX audit_by_time ON audit (at_ms);
