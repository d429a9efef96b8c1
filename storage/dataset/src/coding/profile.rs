//! The encoding of transients by profile: element type, codecs, and instructions for readers.

use serde_json::{Value, json};

use crate::coding::squareroot::SATURATED;
use crate::layout::quantity::{Element, Quantity};
use crate::layout::spec::{DatasetSpec, Profile, decimal};

/// Number of bins of an inner chunk.
const INNER_BINS: u64 = 128;

/// The encoding of a data set's transients.
pub(crate) struct Coding {
    pub element: Element,
    pub attributes: Value,
    /// Number of bins of an inner chunk.
    pub inner_bins: u64,
    shuffle: &'static str,
}

impl Coding {
    /// Returns the encoding of the transient `quantity`.
    pub fn new(quantity: Quantity, spec: &DatasetSpec) -> Self {
        let of = match quantity {
            Quantity::Transient => "",
            Quantity::TransientSpots => " of each spot alone",
            _ => " of some of the spots",
        };
        let overflow = match quantity {
            Quantity::Transient => "overflow".to_owned(),
            _ => format!("subsets.{}.overflow", quantity.name()),
        };
        let decoded_units = "of a render: 1/(m2 sr), radiance per unit pulse energy in each bin; of measured files: theirs, photons or energy";
        let mut attributes = match spec.profile {
            Profile::SqrtU16 { delta } => json!({
                "long_name": format!("transient histogram{of}, square-root code"),
                "delta": decimal(delta),
                "decode": format!("h = (q*{})**2 / scale in float32", delta / 2.0),
                "decoded_units": decoded_units,
                "saturated_code": SATURATED,
                "saturated": format!("exact values stand in manifests/<scene>.json, '{overflow}'"),
            }),
            Profile::CountsU16 => json!({
                "long_name": format!("photon counts{of}"),
                "units": "photons",
                "decode": "h = counts / scale in float32",
                "decoded_units": decoded_units,
                "saturated_code": SATURATED,
                "saturated": format!("exact values of h stand in manifests/<scene>.json, '{overflow}'"),
            }),
            Profile::PlainF32 { round } => {
                let mut attributes = json!({
                    "long_name": format!("transient histogram{of}"),
                    "units": "1/(m2 sr)",
                    "decode": "h = stored value",
                });
                if round > 0.0 {
                    attributes["rounded"] = json!(format!(
                        "to powers of two, with an error of at most {round} of sigma = sqrt(max(h*scale, 1)) photons"
                    ));
                }
                attributes
            }
        };
        attributes["decode_zarr_python"] = json!(five_lines(quantity, spec.profile));
        attributes["error"] = json!(
            "manifests/<scene>.json, 'error': largest and rms error in sigma = sqrt(max(h*scale, 1)), saturated bins"
        );
        if !quantity.spots_of_100().is_empty() {
            attributes["spots"] = json!(quantity.spots_of_100());
        }
        let bins = u64::from(spec.gate.bins);
        let (element, shuffle) = match spec.profile {
            Profile::SqrtU16 { .. } => (Element::U16, "shuffle"),
            Profile::CountsU16 => (Element::U16, "bitshuffle"),
            Profile::PlainF32 { round } if round > 0.0 => (Element::F32, "bitshuffle"),
            Profile::PlainF32 { .. } => (Element::F32, "shuffle"),
        };
        Self {
            element,
            attributes,
            inner_bins: bins.min(INNER_BINS),
            shuffle,
        }
    }

    /// Returns the filter of an inner chunk's blosc codec.
    pub fn shuffle(&self) -> &'static str {
        self.shuffle
    }
}

/// Returns the lines of zarr-python code that read h of scene `i` of the data set in the folder
/// `location`.
fn five_lines(quantity: Quantity, profile: Profile) -> Vec<String> {
    let name = quantity.name();
    let open = "g = zarr.open_group(location, mode='r')  # i is the scene's index".to_owned();
    let decode = match profile {
        Profile::SqrtU16 { .. } => [
            format!("x = g['{name}'][i] * numpy.float32(g['{name}'].attrs['delta'] / 2)"),
            "h = x * x / g['scale'][i]".to_owned(),
        ],
        Profile::CountsU16 => [
            format!("counts = g['{name}'][i]"),
            "h = counts.astype('float32') / g['scale'][i]".to_owned(),
        ],
        Profile::PlainF32 { .. } => return vec![open, format!("h = g['{name}'][i]")],
    };
    let list = match quantity {
        Quantity::Transient => "['overflow']".to_owned(),
        _ => format!("['subsets']['{name}']['overflow']"),
    };
    let [first, second] = decode;
    vec![
        open,
        first,
        second,
        format!(
            "for at, value in json.loads((pathlib.Path(location) / f'manifests/{{i}}.json').read_text()){list}:"
        ),
        "    h.flat[at] = value  # the few saturated bins, exactly".to_owned(),
    ]
}

/// Returns the five lines of xarray code for the root's attributes.
pub(crate) fn decode_lines(spec: &DatasetSpec) -> Value {
    let open = "ds = xarray.open_zarr(location)  # i is the scene's index".to_owned();
    let lit = format!(
        "lit = numpy.unpackbits(ds['visibility'][i].values, axis=0, bitorder='little', count={})  # 1 = lit",
        spec.spots
    );
    let middle: [String; 3] = match spec.profile {
        Profile::SqrtU16 { delta } => [
            format!(
                "q = ds['transient'][i].values.astype('float32') * numpy.float32({})",
                delta / 2.0
            ),
            "h = q * q / ds['scale'][i].values  # radiance; q * q are photons; NaN where the scene is missing".into(),
            "# bins with code 65535 are saturated: their exact values stand in manifests/<i>.json, 'overflow'".into(),
        ],
        Profile::CountsU16 => [
            "counts = ds['transient'][i].values  # photons".into(),
            "h = counts.astype('float32') / ds['scale'][i].values  # radiance; NaN where the scene is missing".into(),
            "# bins with code 65535 are saturated: their exact h stand in manifests/<i>.json, 'overflow'".into(),
        ],
        Profile::PlainF32 { .. } => [
            "h = ds['transient'][i].values  # radiance".into(),
            "photons = h * ds['scale'][i].values  # NaN where the scene is missing".into(),
            "depth = ds['depth'][i].values  # z-depth in metres, not distance along the ray".into(),
        ],
    };
    let mut lines = vec![open];
    lines.extend(middle);
    lines.push(lit);
    json!(lines)
}
