-- As the SQLite schema beside it; times are Unix milliseconds by this server's clock. What differs: houses, and owners
-- that are houses.

-- Coordinators at work. One whose time is up is lost: whoever finds it removes it and takes over its ranges.
CREATE TABLE house (
    id      UUID PRIMARY KEY,
    name    TEXT NOT NULL,
    workers BIGINT NOT NULL,
    until   TIMESTAMPTZ NOT NULL
) WITH (fillfactor = 50);

CREATE TABLE job (
    key          BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id           UUID NOT NULL UNIQUE,
    spec_hash    TEXT NOT NULL,
    spec         TEXT NOT NULL,
    state        BIGINT NOT NULL,
    submitted_ms BIGINT NOT NULL,
    ended_ms     BIGINT,
    tasks        BIGINT,
    done         BIGINT,
    reused       BIGINT,
    dead         BIGINT,
    timed        BIGINT NOT NULL DEFAULT 0,
    seconds      DOUBLE PRECISION NOT NULL DEFAULT 0
);
CREATE INDEX job_by_hash ON job (spec_hash);
CREATE UNIQUE INDEX job_live ON job (spec_hash) WHERE state <= 1;

CREATE TABLE result_set (
    key       BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    store     TEXT NOT NULL,
    dataset   TEXT NOT NULL,
    stage_key BYTEA NOT NULL,
    UNIQUE (store, dataset, stage_key)
);

CREATE TABLE stage (
    key        BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    job        BIGINT NOT NULL REFERENCES job (key),
    ordinal    BIGINT NOT NULL,
    result_set BIGINT NOT NULL REFERENCES result_set (key),
    tasks      BIGINT NOT NULL,
    UNIQUE (job, ordinal)
);
CREATE INDEX stage_by_set ON stage (result_set);

-- Few rows that change often: vacuumed early, and with room for new versions on their pages. No foreign key to house:
-- a lost house's ranges keep its id for the moment between its removal and their taking over (one transaction).
CREATE TABLE task_range (
    id              UUID PRIMARY KEY,
    stage           BIGINT NOT NULL REFERENCES stage (key),
    lo              BIGINT NOT NULL,
    hi              BIGINT NOT NULL CHECK (hi > lo),
    epoch           BIGINT NOT NULL,
    crashes         BIGINT NOT NULL,
    state           BIGINT NOT NULL,
    owner           UUID,
    not_before_ms   BIGINT,
    worker          UUID,
    incarnation     UUID,
    lease_until_ms  BIGINT,
    marks           BYTEA,
    CHECK (state <> 0 OR not_before_ms IS NOT NULL),
    CHECK (state <> 1 OR (owner IS NOT NULL AND worker IS NOT NULL AND incarnation IS NOT NULL
                          AND lease_until_ms IS NOT NULL AND length(marks) = hi - lo))
) WITH (fillfactor = 50, autovacuum_vacuum_scale_factor = 0, autovacuum_vacuum_threshold = 2000);
CREATE INDEX task_range_by_stage ON task_range (stage, state, lo);
CREATE INDEX task_range_by_end ON task_range (stage, state, hi);
CREATE INDEX task_range_by_owner ON task_range (owner) WHERE owner IS NOT NULL;
CREATE INDEX task_range_by_worker ON task_range (worker) WHERE worker IS NOT NULL;

CREATE TABLE output (
    result_set BIGINT NOT NULL REFERENCES result_set (key),
    task       BIGINT NOT NULL,
    manifest   BYTEA NOT NULL CHECK (length(manifest) = 32),
    bytes      BIGINT NOT NULL,
    seconds    DOUBLE PRECISION NOT NULL,
    epoch      BIGINT NOT NULL,
    adopted    BOOLEAN NOT NULL,
    PRIMARY KEY (result_set, task)
);

CREATE TABLE exception (
    stage      BIGINT NOT NULL REFERENCES stage (key),
    task       BIGINT NOT NULL,
    failures   BIGINT NOT NULL,
    crashes    BIGINT NOT NULL,
    dead       BOOLEAN NOT NULL,
    last_error TEXT NOT NULL,
    PRIMARY KEY (stage, task)
);

CREATE TABLE event (
    sequence BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    at_ms    BIGINT NOT NULL,
    job      BIGINT NOT NULL REFERENCES job (key),
    kind     BIGINT NOT NULL,
    lo       BIGINT,
    hi       BIGINT,
    worker   TEXT NOT NULL,
    seconds  DOUBLE PRECISION NOT NULL,
    message  TEXT NOT NULL
);
CREATE INDEX event_by_job ON event (job, sequence);

CREATE TABLE worker (
    id           UUID PRIMARY KEY,
    incarnation  UUID NOT NULL,
    name         TEXT NOT NULL,
    last_seen_ms BIGINT NOT NULL
);
