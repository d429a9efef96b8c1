-- Jobs of several stages, which wait for each other; jobs that are held; whose they are.
ALTER TABLE job ADD COLUMN paused BOOLEAN NOT NULL DEFAULT FALSE;
ALTER TABLE job ADD COLUMN username TEXT NOT NULL DEFAULT '';
CREATE INDEX job_active_by_user ON job (username) WHERE state = 0;

-- state: 0 blocked, 1 open, 2 done, 3 failed. `needs`: ordinals of the stages that must be done, with commas between.
-- `done` and what follows are filled in when the job ends.
ALTER TABLE stage ADD COLUMN state BIGINT NOT NULL DEFAULT 1;
ALTER TABLE stage ADD COLUMN needs TEXT NOT NULL DEFAULT '';
ALTER TABLE stage ADD COLUMN tolerate_dead BOOLEAN NOT NULL DEFAULT FALSE;
ALTER TABLE stage ADD COLUMN done BIGINT;
ALTER TABLE stage ADD COLUMN reused BIGINT;
ALTER TABLE stage ADD COLUMN dead BIGINT;
UPDATE stage SET done = job.done, reused = job.reused, dead = job.dead,
    state = CASE WHEN job.dead > 0 THEN 3 ELSE 2 END
    FROM job WHERE job.key = stage.job AND job.tasks IS NOT NULL;

ALTER TABLE event ADD COLUMN stage BIGINT;
UPDATE event SET stage = 0 WHERE lo IS NOT NULL;
