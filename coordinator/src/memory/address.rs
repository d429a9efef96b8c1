//! Groups addresses that one client may own.

use std::net::IpAddr;

/// Addresses that count as one: an IPv4 address, or a /64 network of IPv6, which one machine may
/// own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct AddressGroup([u8; 8]);

impl From<IpAddr> for AddressGroup {
    fn from(address: IpAddr) -> Self {
        let mut group = [0; 8];
        match address.to_canonical() {
            // No unicast network begins with 0xff.
            IpAddr::V4(v4) => {
                group[0] = 0xff;
                group[4..].copy_from_slice(&v4.octets());
            }
            IpAddr::V6(v6) => group.copy_from_slice(&v6.octets()[..8]),
        }
        Self(group)
    }
}
