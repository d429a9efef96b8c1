//! TensorBoard's event files: a run's scalars, and a sweep's data for the HPARAMS tab.
//!
//! A file consists of TFRecords (length, content, and a masked CRC-32C of each) of `Event`
//! messages. The crates that write this format are unmaintained (`tensorboard-rs`: 2022, without
//! hyperparameters), and only few messages are needed ([`message`]).
//!
//! Records have no date, so the event files have none either: an event's time is its epoch, in
//! seconds. The same records give the same files.

mod message;

use std::{fs, path::Path};

use message::{
    Anything, Content, Data, Event, Experiment, HParamInfo, HParams, Interval, Kind, MetricInfo,
    MetricName, PluginData, SessionEnd, SessionStart, Shape, Summary, SummaryMetadata,
    SummaryValue, Tensor, What, kind, status,
};
use prost::Message as _;
use serde_json::Value;

use crate::error::{Result, io};

/// Name of each event file. TensorBoard requires `tfevents` in the name.
const FILE: &str = "events.out.tfevents.0.picofarm";

/// A run: the contents of one folder.
#[derive(Default)]
pub struct Run {
    events: Vec<Event>,
}

/// How a run ended.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    Well,
    Badly,
}

/// A parameter of a sweep.
pub struct Parameter {
    pub name: String,
    /// The interval of a numeric parameter.
    pub interval: Option<[f64; 2]>,
    /// The values of a list parameter.
    pub listed: Vec<Value>,
}

impl Run {
    /// Adds the numbers of a line of the history. Its `step` is the step, and all others are
    /// scalars by their names; those in a table are called `table/name`.
    pub fn line(&mut self, line: &Value) {
        let step = line["step"].as_i64().unwrap_or(0);
        let mut values = Vec::new();
        scalars(&mut values, "", line);
        self.add(step, values);
    }

    /// Adds a scalar at a step.
    pub fn scalar(&mut self, step: i64, tag: &str, value: f64) {
        self.add(step, vec![scalar(tag, value)]);
    }

    /// Adds the values of a trial's parameters and how it ended, for the HPARAMS tab.
    pub fn trial<'a>(
        &mut self,
        model: &str,
        values: impl Iterator<Item = (&'a String, &'a Value)>,
        ended: Ended,
    ) {
        let start = SessionStart {
            hparams: values.map(|(n, v)| (n.clone(), plain(v))).collect(),
            group_name: model.to_owned(),
            ..SessionStart::default()
        };
        let end = SessionEnd {
            status: match ended {
                Ended::Well => status::SUCCESS,
                Ended::Badly => status::FAILURE,
            },
            end_time_secs: 0.0,
        };
        let start = hparams("_hparams_/session_start_info", What::Start(start));
        let end = hparams("_hparams_/session_end_info", What::End(end));
        self.add(0, vec![start]);
        self.add(0, vec![end]);
    }

    /// Adds the description of a sweep for the HPARAMS tab: its parameters, and the scalar that
    /// better trials minimise.
    pub fn experiment(&mut self, parameters: &[Parameter], metric: (&str, &str)) {
        let experiment = Experiment {
            hparam_infos: parameters.iter().map(info).collect(),
            metric_infos: vec![MetricInfo {
                name: Some(MetricName {
                    group: String::new(),
                    tag: metric.0.to_owned(),
                }),
                display_name: metric.1.to_owned(),
                dataset_type: message::VALIDATION,
            }],
        };
        let value = hparams("_hparams_/experiment", What::Experiment(experiment));
        self.add(0, vec![value]);
    }

    /// Writes the event file into a folder, creating it if missing.
    ///
    /// # Errors
    /// Fails if the folder or the file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).map_err(|e| io(folder.display(), &e))?;
        let file = folder.join(FILE);
        fs::write(&file, self.to_bytes()).map_err(|e| io(file.display(), &e))
    }

    fn to_bytes(&self) -> Vec<u8> {
        let first = Event {
            content: Some(Content::FileVersion("brain.Event:2".into())),
            ..Event::default()
        };
        let mut bytes = Vec::new();
        for event in std::iter::once(&first).chain(&self.events) {
            record(&mut bytes, &event.encode_to_vec());
        }
        bytes
    }

    fn add(&mut self, step: i64, values: Vec<SummaryValue>) {
        self.events.push(Event {
            wall_time: step as f64,
            step,
            content: Some(Content::Summary(Summary { values })),
        });
    }
}

/// Collects the numbers of a JSON document, by their paths.
fn scalars(into: &mut Vec<SummaryValue>, path: &str, value: &Value) {
    match value {
        Value::Object(table) => {
            for (name, value) in table {
                if name == "step" && path.is_empty() {
                    continue;
                }
                let path = match path {
                    "" => name.clone(),
                    _ => format!("{path}/{name}"),
                };
                scalars(into, &path, value);
            }
        }
        value => into.extend(value.as_f64().map(|number| scalar(path, number))),
    }
}

fn scalar(tag: &str, value: f64) -> SummaryValue {
    SummaryValue {
        tag: tag.to_owned(),
        metadata: None,
        value: Some(Data::Simple(value as f32)),
    }
}

fn info(parameter: &Parameter) -> HParamInfo {
    let numbers = parameter.listed.iter().all(Value::is_number);
    let truths = parameter.listed.iter().all(Value::is_boolean);
    HParamInfo {
        name: parameter.name.clone(),
        kind: match (parameter.listed.is_empty() || numbers, truths) {
            (true, _) => kind::FLOAT64,
            (false, true) => kind::BOOL,
            (false, false) => kind::STRING,
        },
        discrete: (!parameter.listed.is_empty()).then(|| message::List {
            values: parameter.listed.iter().map(plain).collect(),
        }),
        interval: parameter.interval.map(|[min_value, max_value]| Interval {
            min_value,
            max_value,
        }),
    }
}

/// Converts a value to the form that the tab displays.
fn plain(value: &Value) -> Anything {
    let kind = match value {
        Value::Bool(truth) => Kind::Bool(*truth),
        Value::String(text) => Kind::Text(text.clone()),
        other => match other.as_f64() {
            Some(number) => Kind::Number(number),
            None => Kind::Text(other.to_string()),
        },
    };
    Anything { kind: Some(kind) }
}

/// Writes a record: length, its checksum, content, its checksum.
fn record(into: &mut Vec<u8>, content: &[u8]) {
    let length = (content.len() as u64).to_le_bytes();
    into.extend(length);
    into.extend(masked(&length).to_le_bytes());
    into.extend(content);
    into.extend(masked(content).to_le_bytes());
}

/// Returns TFRecord's checksum: a CRC-32C, rotated and offset so that a checksum of checksums is
/// not a constant.
fn masked(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

/// Returns the metadata for the HPARAMS tab, with the empty tensor that it requires.
fn hparams(tag: &str, what: What) -> SummaryValue {
    let content = HParams { what: Some(what) }.encode_to_vec();
    let nothing = Tensor {
        dtype: message::FLOAT,
        shape: Some(Shape {
            dim: vec![message::Dim { size: 0 }],
        }),
    };
    SummaryValue {
        tag: tag.to_owned(),
        metadata: Some(SummaryMetadata {
            plugin: Some(PluginData {
                name: "hparams".into(),
                content,
            }),
        }),
        value: Some(Data::Tensor(nothing)),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Reads the contents of a file back and checks each checksum.
    fn read(mut bytes: &[u8]) -> Vec<Event> {
        let mut events = Vec::new();
        while !bytes.is_empty() {
            let (head, rest) = bytes.split_at(12);
            let length = u64::from_le_bytes(head[..8].try_into().unwrap()) as usize;
            assert_eq!(head[8..], masked(&head[..8]).to_le_bytes());
            let (content, rest) = rest.split_at(length);
            assert_eq!(rest[..4], masked(content).to_le_bytes());
            events.push(Event::decode(content).unwrap());
            bytes = &rest[4..];
        }
        events
    }

    #[test]
    fn a_checksum_is_the_published_one() {
        // RFC 3720, B.4: 32 bytes of zeros have 8a9136aa; the mask is TensorFlow's.
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(masked(&[0; 32]), 0x6d55_1522u32.wrapping_add(0xa282_ead8));
    }

    #[test]
    fn lines_become_scalars_at_their_steps() {
        let mut run = Run::default();
        run.line(&json!({"epoch": 1, "step": 4, "loss": 0.5, "learning_rate": 1e-3, "validation": {"mae_m": 0.25, "rmse_m": 0.5}}));
        run.line(&json!({"epoch": 2, "step": 8, "loss": 0.25, "learning_rate": 1e-3}));
        let events = read(&run.to_bytes());
        assert_eq!(events.len(), 3);
        assert_eq!(
            events[0].content,
            Some(Content::FileVersion("brain.Event:2".into()))
        );
        let found: Vec<(i64, Vec<(String, f32)>)> = events[1..]
            .iter()
            .map(|event| {
                let Some(Content::Summary(summary)) = &event.content else {
                    panic!("{event:?}");
                };
                let values = summary.values.iter().map(|v| match v.value {
                    Some(Data::Simple(x)) => (v.tag.clone(), x),
                    _ => panic!("{v:?}"),
                });
                (event.step, values.collect())
            })
            .collect();
        let tags: Vec<&str> = found[0].1.iter().map(|(tag, _)| &**tag).collect();
        let mut sorted = tags.clone();
        sorted.sort_unstable();
        assert_eq!(
            sorted,
            [
                "epoch",
                "learning_rate",
                "loss",
                "validation/mae_m",
                "validation/rmse_m"
            ]
        );
        assert_eq!((found[0].0, found[1].0), (4, 8));
        assert!(found[1].1.contains(&("loss".to_owned(), 0.25)));
    }

    #[test]
    fn a_trial_says_its_values_and_how_it_ended() {
        let mut run = Run::default();
        let values = [
            ("lr".to_owned(), json!(0.01)),
            ("width".to_owned(), json!(8)),
            ("kind".to_owned(), json!("cosine")),
            ("flip".to_owned(), json!(true)),
        ];
        run.trial("m.3", values.iter().map(|(n, v)| (n, v)), Ended::Badly);
        let events = read(&run.to_bytes());
        let content = |event: &Event| {
            let Some(Content::Summary(summary)) = &event.content else {
                panic!("{event:?}");
            };
            let value = &summary.values[0];
            let plugin = value.metadata.as_ref().unwrap().plugin.as_ref().unwrap();
            assert_eq!(plugin.name, "hparams");
            let data = message::HParams::decode(&plugin.content[..]).unwrap();
            (value.tag.clone(), data.what.unwrap())
        };
        let (tag, What::Start(start)) = content(&events[1]) else {
            panic!()
        };
        assert_eq!(tag, "_hparams_/session_start_info");
        assert_eq!(start.group_name, "m.3");
        let of = |name: &str| start.hparams[name].kind.clone().unwrap();
        assert_eq!(of("lr"), Kind::Number(0.01));
        assert_eq!(of("width"), Kind::Number(8.0));
        assert_eq!(of("kind"), Kind::Text("cosine".into()));
        assert_eq!(of("flip"), Kind::Bool(true));
        let (tag, What::End(end)) = content(&events[2]) else {
            panic!()
        };
        assert_eq!(tag, "_hparams_/session_end_info");
        assert_eq!(end.status, status::FAILURE);
    }
}
