//! Tests that processes that train together compute the bits of a single process, for any number of
//! processes, and even if some arrive, leave or die. Here each process is a thread with its own
//! connections; the tests of the whole farm kill real processes.

#[path = "../../model/tests/it/common/mod.rs"]
#[expect(dead_code, reason = "other tests need more of it")]
mod common;

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    net::TcpStream,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use burn::tensor::Device;
use common::{plan, scenes};
use picofarm_members::{Call, Members, Rendezvous};
use picofarm_model::{
    ModelError,
    input::{ShadowVariant, Target},
    scene::Scenes,
    train::{Control, Ended, Event, Plan, Sources, Trained, Training},
};

/// Calls in memory.
#[derive(Default)]
struct Board(Mutex<BTreeMap<u64, Call>>);

impl Board {
    fn newest_call(&self) -> Option<Call> {
        self.newest().unwrap().map(|(_, call)| call)
    }
}

impl Rendezvous for Board {
    fn newest(&self) -> Result<Option<(u64, Call)>, String> {
        let calls = self.0.lock().unwrap();
        Ok(calls.last_key_value().map(|(n, call)| (*n, call.clone())))
    }

    fn make(&self, number: u64, call: &Call) -> Result<bool, String> {
        let mut calls = self.0.lock().unwrap();
        if calls.contains_key(&number) {
            return Ok(false);
        }
        calls.insert(number, call.clone());
        Ok(true)
    }
}

fn sources() -> Sources {
    Sources {
        train: Arc::new(scenes(0, 26)),
        validation: Arc::new(scenes(100, 3)),
    }
}

fn of_steps(accumulate: usize) -> Plan {
    Plan {
        accumulate,
        epochs: 4,
        ..plan(Target::Shadow, ShadowVariant::Concat)
    }
}

fn training(plan: &Plan) -> Training {
    Training::start(plan.clone(), None, sources(), &Device::flex()).unwrap()
}

fn alone(plan: &Plan) -> Trained {
    let mut training = training(plan);
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

/// Runs one process. Returns its result, if it was the leading process at the end.
fn process(
    board: &Board,
    plan: &Plan,
    stopped: &dyn Fn() -> bool,
    say: &mut dyn FnMut(&Training, &Event) -> Control,
) -> (Ended, Option<Trained>) {
    let mut training = training(plan);
    let mut members = Members::new(board, "127.0.0.1", "a training", "here", stopped).unwrap();
    let ended = training.run_among(&mut members, say).unwrap();
    if ended != Ended::Finished {
        return (ended, None);
    }
    members.announce_end();
    (ended, Some(training.finish()))
}

fn assert_same(one: &Trained, other: &Trained) {
    assert_eq!(one.history, other.history);
    assert!(one.weights == other.weights, "other weights");
}

#[test]
fn any_number_of_processes_comes_to_the_bits_of_one() {
    for (accumulate, processes) in [
        (1, 2),
        (2, 2),
        (4, 2),
        (4, 3),
        (4, 4),
        (6, 2),
        (6, 4),
        (3, 5),
    ] {
        let plan = of_steps(accumulate);
        let expected = alone(&plan);
        let board = Board::default();
        // No process continues before all have arrived.
        let together = AtomicU64::new(0);
        let found: Vec<(Ended, Option<Trained>)> = thread::scope(|scope| {
            let mut running = Vec::new();
            for _ in 0..processes {
                running.push(scope.spawn(|| {
                    let mut first = true;
                    process(&board, &plan, &|| false, &mut |_, _| {
                        if std::mem::take(&mut first) {
                            together.fetch_add(1, Ordering::SeqCst);
                        }
                        Control::Continue
                    })
                }));
            }
            running.into_iter().map(|r| r.join().unwrap()).collect()
        });
        let kept: Vec<&Trained> = found.iter().filter_map(|(_, kept)| kept.as_ref()).collect();
        assert!(
            !kept.is_empty(),
            "{accumulate} batches, {processes} processes"
        );
        for kept in kept {
            assert_same(kept, &expected);
        }
        assert!(
            found
                .iter()
                .all(|(ended, _)| matches!(ended, Ended::Finished | Ended::Elsewhere))
        );
    }
}

/// With this step length the loss becomes NaN or infinite. A process that computes it ends, and no
/// other waits.
#[test]
fn a_step_that_cannot_be_computed_ends_the_training_of_all() {
    let plan = Plan {
        learning_rate: 1e30,
        ..of_steps(2)
    };
    let board = Board::default();
    let steps = AtomicU64::new(0);
    let errors: Vec<ModelError> = thread::scope(|scope| {
        let run = || {
            let never = || false;
            let mut training = training(&plan);
            let mut members = Members::new(&board, "127.0.0.1", "t", "here", &never).unwrap();
            let ended = training.run_among(&mut members, &mut |_, _| {
                steps.fetch_add(1, Ordering::SeqCst);
                // This gives the other process time to arrive.
                thread::sleep(Duration::from_millis(500));
                Control::Continue
            });
            ended.unwrap_err()
        };
        let both = [scope.spawn(run), scope.spawn(run)];
        both.map(|process| process.join().unwrap()).into()
    });
    for error in errors {
        assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
    }
    assert!(
        steps.load(Ordering::SeqCst) <= 2,
        "nobody took another step"
    );
}

#[test]
fn processes_come_and_leave_between_steps_and_no_bit_changes() {
    let plan = Plan {
        epochs: 30,
        ..of_steps(4)
    };
    let expected = alone(&plan);
    let board = Board::default();
    let step = AtomicU64::new(0);
    let found: Vec<Option<Trained>> = thread::scope(|scope| {
        let mut running = Vec::new();
        // Each process begins at one step and leaves at another, including the first one, which
        // leads.
        for (from, to) in [
            (0, 22),
            (3, 40),
            (9, 30),
            (25, u64::MAX),
            (33, 60),
            (45, u64::MAX),
        ] {
            let (board, plan, step) = (&board, &plan, &step);
            running.push(scope.spawn(move || {
                while step.load(Ordering::SeqCst) < from {
                    thread::sleep(Duration::from_millis(1));
                }
                let (ended, kept) = process(board, plan, &|| false, &mut |training, _| {
                    let at = training.learner().steps();
                    step.fetch_max(at, Ordering::SeqCst);
                    // Long enough for others to arrive.
                    thread::sleep(Duration::from_millis(10));
                    match at >= to {
                        true => Control::Stop,
                        false => Control::Continue,
                    }
                });
                assert_eq!(
                    ended == Ended::Stopped,
                    to < u64::MAX,
                    "{from}..{to}: {ended:?}"
                );
                kept
            }));
        }
        running.into_iter().map(|r| r.join().unwrap()).collect()
    });
    let kept: Vec<Trained> = found.into_iter().flatten().collect();
    assert!(!kept.is_empty());
    for kept in kept {
        assert_same(&kept, &expected);
    }
}

#[test]
fn an_early_end_is_the_same_for_all_and_keeps_the_same_epoch() {
    let plan = Plan {
        epochs: 40,
        early_stop: 2,
        learning_rate: 0.3,
        ..of_steps(2)
    };
    ends_early(&plan);
    // The same within epochs.
    ends_early(&Plan {
        validate_every: 1,
        early_stop: 3,
        ..plan
    });
}

fn ends_early(plan: &Plan) {
    let expected = alone(plan);
    assert!(expected.stopped_early, "{:?}", expected.history);
    let board = Board::default();
    let found: Vec<(Ended, Option<Trained>)> = thread::scope(|scope| {
        let go = || process(&board, plan, &|| false, &mut |_, _| Control::Continue);
        let running = [scope.spawn(go), scope.spawn(go)];
        running.map(|r| r.join().unwrap()).into()
    });
    for kept in found.iter().filter_map(|(_, kept)| kept.as_ref()) {
        assert_same(kept, &expected);
        assert_eq!(kept.kept_step, expected.kept_step);
    }
}

#[test]
fn connections_without_the_secret_disturb_nothing() {
    let plan = Plan {
        epochs: 10,
        ..of_steps(2)
    };
    let expected = alone(&plan);
    let board = Board::default();
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut sent = 0_u64;
            while !over.load(Ordering::SeqCst) {
                let Some(call) = board.newest_call() else {
                    continue;
                };
                let Ok(mut stream) = TcpStream::connect(&call.address) else {
                    continue;
                };
                sent += 1;
                let bytes: Vec<u8> = match sent % 5 {
                    0 => b"GET / HTTP/1.1\r\n\r\n".to_vec(),
                    1 => vec![0xff; 4096],
                    // A header of 4 GiB.
                    2 => [&b"pfm2"[..], &[0xff; 12]].concat(),
                    3 => {
                        let text = br#"{"hello":{"secret":"guessed","training":"a training","wish":{"add":{"generation":1,"rank":1}}}}"#;
                        let mut bytes = b"pfm2".to_vec();
                        bytes.extend((text.len() as u32).to_le_bytes());
                        bytes.extend(0_u64.to_le_bytes());
                        bytes.extend(text);
                        bytes
                    }
                    // Sends nothing, and stays connected.
                    _ => Vec::new(),
                };
                let _ = stream.write_all(&bytes);
                if sent % 5 < 4 {
                    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
                    let mut answer = Vec::new();
                    let _ = stream.read_to_end(&mut answer);
                    assert!(answer.is_empty(), "{answer:?}");
                }
                thread::sleep(Duration::from_millis(1));
            }
        });
        let go = || {
            process(&board, &plan, &|| false, &mut |_, _| {
                thread::sleep(Duration::from_millis(2));
                Control::Continue
            })
        };
        let running = [scope.spawn(go), scope.spawn(go)];
        for (_, kept) in running.map(|r| r.join().unwrap()) {
            if let Some(kept) = kept {
                assert_same(&kept, &expected);
            }
        }
        over.store(true, Ordering::SeqCst);
    });
}

#[test]
fn a_call_that_nobody_answers_is_followed_by_another() {
    let plan = of_steps(2);
    let board = Board::default();
    // An unreachable machine, and one that listens but sends nothing.
    let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    for address in [
        "127.0.0.1:1".to_owned(),
        silent.local_addr().unwrap().to_string(),
    ] {
        let number = board.0.lock().unwrap().len() as u64 + 1;
        let call = Call {
            address,
            secret: "x".into(),
            machine: "gone".into(),
        };
        assert!(board.make(number, &call).unwrap());
    }
    let (ended, kept) = process(&board, &plan, &|| false, &mut |_, _| Control::Continue);
    assert_eq!(ended, Ended::Finished);
    assert_same(&kept.unwrap(), &alone(&plan));
    assert_eq!(board.0.lock().unwrap().len(), 3);
}

#[test]
fn whoever_is_asked_to_stop_stops_although_others_keep_it_waiting() {
    let plan = of_steps(2);
    let board = Board::default();
    let (stop, over) = (AtomicBool::new(false), AtomicBool::new(false));
    thread::scope(|scope| {
        // The leading process is slow in a step.
        let slow = scope.spawn(|| {
            process(
                &board,
                &plan,
                &|| over.load(Ordering::SeqCst),
                &mut |_, _| {
                    while !over.load(Ordering::SeqCst) {
                        thread::sleep(Duration::from_millis(5));
                    }
                    Control::Stop
                },
            )
        });
        while board.newest_call().is_none() {
            thread::sleep(Duration::from_millis(1));
        }
        let other = scope.spawn(|| {
            process(
                &board,
                &plan,
                &|| stop.load(Ordering::SeqCst),
                &mut |_, _| Control::Continue,
            )
        });
        thread::sleep(Duration::from_millis(500));
        stop.store(true, Ordering::SeqCst);
        assert_eq!(other.join().unwrap().0, Ended::Stopped);
        over.store(true, Ordering::SeqCst);
        assert_eq!(slow.join().unwrap().0, Ended::Stopped);
    });
}

#[test]
fn scenes_are_read_by_whoever_has_them_and_no_more() {
    /// Counts the scenes that are read.
    struct Counted(Vec<Arc<picofarm_model::scene::Scene>>, AtomicU64);
    impl Scenes for Counted {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn load(
            &self,
            index: usize,
        ) -> Result<Arc<picofarm_model::scene::Scene>, picofarm_model::scene::Unreadable> {
            self.1.fetch_add(1, Ordering::SeqCst);
            Ok(self.0[index].clone())
        }
    }
    let plan = Plan {
        epochs: 20,
        ..of_steps(4)
    };
    let board = Board::default();
    let counts: Vec<u64> = thread::scope(|scope| {
        let (board, plan) = (&board, &plan);
        let go = move || {
            let counted = Arc::new(Counted(scenes(0, 26), AtomicU64::new(0)));
            let sources = Sources {
                train: counted.clone(),
                validation: Arc::new(scenes(100, 0)),
            };
            let mut training =
                Training::start(plan.clone(), None, sources, &Device::flex()).unwrap();
            let mut members =
                Members::new(board, "127.0.0.1", "a training", "here", &|| false).unwrap();
            if training
                .run_among(&mut members, &mut |_, _| {
                    thread::sleep(Duration::from_millis(3));
                    Control::Continue
                })
                .unwrap()
                == Ended::Finished
            {
                members.announce_end();
            }
            counted.1.load(Ordering::SeqCst)
        };
        let running = [scope.spawn(go), scope.spawn(go)];
        running.map(|r| r.join().unwrap()).into()
    });
    // 20 epochs of 24 scenes, half of them by each process. Scenes prepared when the other process
    // arrived are prepared again.
    for count in &counts {
        assert!((200..=330).contains(count), "{counts:?}");
    }
}
