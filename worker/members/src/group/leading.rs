//! The leading process: it records who takes part, and brings all to the same state.

use std::{
    collections::VecDeque,
    sync::mpsc::RecvTimeoutError,
    time::{Duration, Instant},
};

use picofarm_model::{
    ModelError,
    train::group::{Member, Next, share},
};
use tracing::info;

use super::{ASK, Members, Role, WaitResult, failed};
use crate::{
    link::{Link, LinkEvent},
    message::{Address, Message},
};

/// Interval at which a lone process checks for newer calls of others.
const LOOK: Duration = Duration::from_secs(20);

/// The state of the leading process.
pub(super) struct Leads {
    /// Number of its call.
    pub(super) number: u64,
    pub(super) others: Vec<Other>,
    /// Processes that have arrived and take part from the next agreement on.
    pub(super) coming: Vec<Other>,
    /// Whether a process was lost.
    pub(super) lost: bool,
    pub(super) looked: Instant,
}

impl Leads {
    /// Returns the state after this process has made the call with this number.
    pub(super) fn new(number: u64) -> Self {
        Self {
            number,
            others: Vec::new(),
            coming: Vec::new(),
            lost: false,
            looked: Instant::now(),
        }
    }
}

/// Another process, as the leading one knows it.
pub(super) struct Other {
    pub(super) link: Link,
    pub(super) address: Address,
    /// Messages of the process that were not read yet.
    said: VecDeque<(Message, Vec<u8>)>,
}

impl Other {
    pub(super) fn new(link: Link, address: Address) -> Self {
        Self {
            link,
            address,
            said: VecDeque::new(),
        }
    }
}

impl Members<'_> {
    /// On the leading process, lets all members take one more step. Returns `false` if they must
    /// agree anew first.
    pub(super) fn lead_on(&mut self) -> bool {
        self.greet();
        self.record_events();
        let Role::Leads(leads) = &mut self.role else {
            return false;
        };
        if leads.lost || !leads.coming.is_empty() {
            return false;
        }
        if leads.others.is_empty() {
            let number = leads.number;
            if leads.looked.elapsed() < LOOK {
                return true;
            }
            leads.looked = Instant::now();
            // If the place is unreachable now, it is tried again later.
            return !self.superseded(number).unwrap_or(false);
        }
        let mut others = leads.others.iter();
        others.all(|other| other.link.say(&Message::Go, &[]))
    }

    /// On the leading process, records incoming messages.
    pub(super) fn record_events(&mut self) {
        while let Ok((id, heard)) = self.events.try_recv() {
            self.record_event(id, heard);
        }
    }

    pub(super) fn record_event(&mut self, id: u64, heard: LinkEvent) {
        let Role::Leads(leads) = &mut self.role else {
            return;
        };
        match heard {
            LinkEvent::Lost => {
                let before = leads.others.len();
                leads.others.retain(|other| other.link.id != id);
                leads.coming.retain(|other| other.link.id != id);
                leads.lost |= leads.others.len() < before;
            }
            LinkEvent::Message(message, payload) => {
                let failed = matches!(&message, Message::Failed { generation } if *generation == self.generation);
                leads.lost |= failed;
                let mut all = leads.others.iter_mut().chain(&mut leads.coming);
                if let Some(other) = all.find(|other| other.link.id == id) {
                    other.said.push_back((message, payload));
                }
            }
        }
    }

    /// On the leading process, waits for the next message of a link.
    pub(super) fn next_message_of(&mut self, id: u64) -> WaitResult {
        loop {
            let Role::Leads(leads) = &mut self.role else {
                return WaitResult::Lost;
            };
            let Some(other) = leads.others.iter_mut().find(|other| other.link.id == id) else {
                return WaitResult::Lost;
            };
            if let Some((message, payload)) = other.said.pop_front() {
                return WaitResult::Message(message, payload);
            }
            match self.events.recv_timeout(ASK) {
                Ok((from, heard)) => self.record_event(from, heard),
                Err(RecvTimeoutError::Timeout) if (self.stopped)() => return WaitResult::Stop,
                Err(_) => {}
            }
        }
    }

    /// On the leading process, brings all members to the state of the most advanced one. Returns
    /// `None` if this must be repeated.
    pub(super) fn gather(&mut self, member: &mut dyn Member) -> Result<Option<Next>, ModelError> {
        self.mesh = None;
        self.breaker.break_off();
        self.greet();
        self.record_events();
        let Role::Leads(leads) = &mut self.role else {
            return Ok(None);
        };
        if leads.others.is_empty() && leads.coming.is_empty() {
            let number = leads.number;
            leads.looked = Instant::now();
            if self.superseded(number)? {
                return Ok(None);
            }
        }
        let Role::Leads(leads) = &mut self.role else {
            return Ok(None);
        };
        let coming = std::mem::take(&mut leads.coming);
        leads.others.extend(coming);
        leads.lost = false;
        // Ends their current agreement.
        for other in &leads.others {
            other.link.say(&Message::Where, &[]);
        }
        let ids: Vec<u64> = leads.others.iter().map(|other| other.link.id).collect();
        let mut stand = Vec::new();
        for id in ids {
            loop {
                match self.next_message_of(id) {
                    WaitResult::Message(Message::Stands(at), _) => stand.push((id, at)),
                    // A message of the previous agreement.
                    WaitResult::Message(..) => continue,
                    WaitResult::Lost => {}
                    WaitResult::Stop => return Ok(Some(Next::Stop)),
                }
                break;
            }
        }
        let furthest = stand.iter().max_by_key(|(_, at)| *at);
        if let Some((id, at)) = furthest
            && *at > member.standing()
        {
            let state = match self.request_state(*id) {
                WaitResult::Message(_, state) => state,
                WaitResult::Lost => return Ok(None),
                WaitResult::Stop => return Ok(Some(Next::Stop)),
            };
            member.become_state(&state)?;
        }
        let ours = member.standing();
        let mut state = None;
        for (id, _) in stand.iter().filter(|(_, at)| *at < ours) {
            let state = state.get_or_insert_with(|| member.state());
            if let Some(other) = self.other(*id) {
                other.link.say(&Message::State, state);
            }
        }
        drop(state);
        self.form()
    }

    fn other(&self, id: u64) -> Option<&Other> {
        let Role::Leads(leads) = &self.role else {
            return None;
        };
        leads.others.iter().find(|other| other.link.id == id)
    }

    fn request_state(&mut self, id: u64) -> WaitResult {
        let asked = self
            .other(id)
            .is_some_and(|other| other.link.say(&Message::SendState, &[]));
        if !asked {
            return WaitResult::Lost;
        }
        loop {
            match self.next_message_of(id) {
                WaitResult::Message(Message::State, state) => {
                    return WaitResult::Message(Message::State, state);
                }
                WaitResult::Message(..) => {}
                other => return other,
            }
        }
    }

    /// On the leading process, determines who takes part from now on.
    fn form(&mut self) -> Result<Option<Next>, ModelError> {
        self.generation += 1;
        let generation = self.generation;
        let Role::Leads(leads) = &self.role else {
            return Ok(None);
        };
        let mut members = vec![self.endpoint.address().clone()];
        members.extend(leads.others.iter().map(|other| other.address.clone()));
        for (i, other) in leads.others.iter().enumerate() {
            let form = Message::Form {
                generation,
                rank: i + 1,
                members: members.clone(),
            };
            other.link.say(&form, &[]);
        }
        let ids: Vec<u64> = leads.others.iter().map(|other| other.link.id).collect();
        let mesh = match self.connect(0, &members) {
            Ok(mesh) => mesh,
            Err(_) if (self.stopped)() => return Ok(Some(Next::Stop)),
            Err(error) => {
                info!(%error, "not all processes of the training are connected; once more");
                return Ok(None);
            }
        };
        for id in ids {
            loop {
                match self.next_message_of(id) {
                    WaitResult::Message(Message::Formed { generation: of }, _)
                        if of == generation =>
                    {
                        break;
                    }
                    WaitResult::Message(Message::Failed { generation: of }, _)
                        if of == generation =>
                    {
                        return Ok(None);
                    }
                    WaitResult::Message(..) => {}
                    WaitResult::Lost => return Ok(None),
                    WaitResult::Stop => return Ok(Some(Next::Stop)),
                }
            }
        }
        let n = members.len();
        if n > 1 {
            info!("{n} processes train together; this one leads");
        }
        self.mesh = Some(mesh);
        Ok(Some(Next::Train {
            share: share(self.batches, 0, n),
            leads: true,
        }))
    }

    /// Returns whether others have made a newer call. In that case this process joins them.
    fn superseded(&mut self, number: u64) -> Result<bool, ModelError> {
        let newest = self.rendezvous.newest().map_err(failed)?;
        let superseded = newest.is_some_and(|(newest, _)| newest > number);
        if superseded {
            info!("other processes of the training have called anew; this one goes to them");
            self.endpoint.lead(false);
            self.role = Role::None;
        }
        Ok(superseded)
    }
}
