-- Jobs that begin when other jobs are done.
CREATE TABLE job_after (
    job   BIGINT NOT NULL REFERENCES job (key),
    needs BIGINT NOT NULL REFERENCES job (key),
    PRIMARY KEY (job, needs)
);
CREATE INDEX job_after_by_needs ON job_after (needs);
