-- Jobs, their ranges, and the outputs that outlive them. Ids are 16-byte UUIDs; times are Unix milliseconds.

-- `tasks` and what follows are filled in when the job ends.
CREATE TABLE job (
    key          INTEGER PRIMARY KEY,
    id           BLOB NOT NULL UNIQUE,
    spec_hash    TEXT NOT NULL,
    spec         TEXT NOT NULL,
    state        INTEGER NOT NULL,
    submitted_ms INTEGER NOT NULL,
    ended_ms     INTEGER,
    tasks        INTEGER,
    done         INTEGER,
    reused       INTEGER,
    dead         INTEGER,
    timed        INTEGER NOT NULL DEFAULT 0,
    seconds      REAL NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX job_by_hash ON job (spec_hash);
-- One job for each spec, but for those that ended badly.
CREATE UNIQUE INDEX job_live ON job (spec_hash) WHERE state <= 1;

-- Where results of one kind live: a data set in a store, and what shapes its results.
CREATE TABLE result_set (
    key       INTEGER PRIMARY KEY,
    store     TEXT NOT NULL,
    dataset   TEXT NOT NULL,
    stage_key BLOB NOT NULL,
    UNIQUE (store, dataset, stage_key)
) STRICT;

CREATE TABLE stage (
    key        INTEGER PRIMARY KEY,
    job        INTEGER NOT NULL REFERENCES job (key),
    ordinal    INTEGER NOT NULL,
    result_set INTEGER NOT NULL REFERENCES result_set (key),
    tasks      INTEGER NOT NULL,
    UNIQUE (job, ordinal)
) STRICT;
CREATE INDEX stage_by_set ON stage (result_set);

-- Consecutive tasks of a stage in one state. `marks` has a byte for each task of a leased range. `owner` is 1 where
-- the coordinator has the range in hand; done and dead ranges are nobody's.
CREATE TABLE task_range (
    id              BLOB PRIMARY KEY,
    stage           INTEGER NOT NULL REFERENCES stage (key),
    lo              INTEGER NOT NULL,
    hi              INTEGER NOT NULL CHECK (hi > lo),
    epoch           INTEGER NOT NULL,
    crashes         INTEGER NOT NULL,
    state           INTEGER NOT NULL,
    owner           INTEGER,
    not_before_ms   INTEGER,
    worker          BLOB,
    incarnation     BLOB,
    lease_until_ms  INTEGER,
    marks           BLOB,
    CHECK (state <> 0 OR not_before_ms IS NOT NULL),
    CHECK (state <> 1 OR (owner IS NOT NULL AND worker IS NOT NULL AND incarnation IS NOT NULL
                          AND lease_until_ms IS NOT NULL AND length(marks) = hi - lo))
) STRICT, WITHOUT ROWID;
CREATE INDEX task_range_by_stage ON task_range (stage, state, lo);
CREATE INDEX task_range_by_end ON task_range (stage, state, hi);

-- Committed results: written once, never changed.
CREATE TABLE output (
    result_set INTEGER NOT NULL REFERENCES result_set (key),
    task       INTEGER NOT NULL,
    manifest   BLOB NOT NULL CHECK (length(manifest) = 32),
    bytes      INTEGER NOT NULL,
    seconds    REAL NOT NULL,
    epoch      INTEGER NOT NULL,
    adopted    INTEGER NOT NULL,
    PRIMARY KEY (result_set, task)
) STRICT, WITHOUT ROWID;

-- Tasks that failed; all others have no row of their own.
CREATE TABLE exception (
    stage      INTEGER NOT NULL REFERENCES stage (key),
    task       INTEGER NOT NULL,
    failures   INTEGER NOT NULL,
    crashes    INTEGER NOT NULL,
    dead       INTEGER NOT NULL,
    last_error TEXT NOT NULL,
    PRIMARY KEY (stage, task)
) STRICT, WITHOUT ROWID;

-- History, only ever appended to. `lo..hi` are the tasks concerned, where any are.
CREATE TABLE event (
    sequence INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms    INTEGER NOT NULL,
    job      INTEGER NOT NULL REFERENCES job (key),
    kind     INTEGER NOT NULL,
    lo       INTEGER,
    hi       INTEGER,
    worker   TEXT NOT NULL,
    seconds  REAL NOT NULL,
    message  TEXT NOT NULL
) STRICT;
CREATE INDEX event_by_job ON event (job, sequence);

CREATE TABLE worker (
    id           BLOB PRIMARY KEY,
    incarnation  BLOB NOT NULL,
    name         TEXT NOT NULL,
    last_seen_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
