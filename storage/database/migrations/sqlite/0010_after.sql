-- Jobs that begin when other jobs are done.
CREATE TABLE job_after (
    job   INTEGER NOT NULL REFERENCES job (key),
    needs INTEGER NOT NULL REFERENCES job (key),
    PRIMARY KEY (job, needs)
) STRICT, WITHOUT ROWID;
CREATE INDEX job_after_by_needs ON job_after (needs);
