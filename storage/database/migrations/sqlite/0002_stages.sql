-- Jobs of several stages, which wait for each other; jobs that are held; whose they are.
ALTER TABLE job ADD COLUMN paused INTEGER NOT NULL DEFAULT 0;
ALTER TABLE job ADD COLUMN username TEXT NOT NULL DEFAULT '';
CREATE INDEX job_active_by_user ON job (username) WHERE state = 0;

-- state: 0 blocked, 1 open, 2 done, 3 failed. `needs`: ordinals of the stages that must be done, with commas between.
-- `done` and what follows are filled in when the job ends.
ALTER TABLE stage ADD COLUMN state INTEGER NOT NULL DEFAULT 1;
ALTER TABLE stage ADD COLUMN needs TEXT NOT NULL DEFAULT '';
ALTER TABLE stage ADD COLUMN tolerate_dead INTEGER NOT NULL DEFAULT 0;
ALTER TABLE stage ADD COLUMN done INTEGER;
ALTER TABLE stage ADD COLUMN reused INTEGER;
ALTER TABLE stage ADD COLUMN dead INTEGER;
UPDATE stage SET done = job.done, reused = job.reused, dead = job.dead,
    state = CASE WHEN job.dead > 0 THEN 3 ELSE 2 END
    FROM job WHERE job.key = stage.job AND job.tasks IS NOT NULL;

ALTER TABLE event ADD COLUMN stage INTEGER;
UPDATE event SET stage = 0 WHERE lo IS NOT NULL;
