//! A process in a group that trains one network.

use std::{
    collections::VecDeque,
    io,
    net::TcpStream,
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use picofarm_model::{
    ModelError,
    train::{
        Line,
        group::{Compute, Group, Member, Next, Part, share},
    },
};
use tracing::{info, warn};

use crate::{
    Call, Rendezvous,
    endpoint::{Endpoint, visit},
    link::{Heard, Link},
    mesh::{Breaker, Mesh},
    message::{Address, Message, Wish},
};

/// Interval at which a waiting process checks whether to stop.
const ASK: Duration = Duration::from_millis(100);
/// Timeout for connecting all processes with one another.
const CONNECTED_WITHIN: Duration = Duration::from_secs(20);
/// Interval at which a lone process checks for newer calls of others.
const LOOK: Duration = Duration::from_secs(20);
/// Maximum number of processes.
const MOST: usize = 1024;

/// A process in a group that trains one network. Dropping it leaves the group.
pub struct Members<'a> {
    rendezvous: &'a dyn Rendezvous,
    stopped: &'a dyn Fn() -> bool,
    training: String,
    machine: String,
    endpoint: Endpoint,
    breaker: Arc<Breaker>,
    heard: Receiver<(u64, Heard)>,
    hears: Sender<(u64, Heard)>,
    /// Connections for the all-reduce that arrived before this process knew of the agreement.
    early: Vec<(u64, usize, TcpStream)>,
    role: Role,
    mesh: Option<Mesh>,
    batches: usize,
    generation: u64,
    links: u64,
}

enum Role {
    /// Not in the group yet.
    None,
    Leads(Leads),
    Follows {
        link: Link,
        /// The last message of the leading process that was not handled yet.
        said: Option<(Message, Vec<u8>)>,
    },
}

struct Leads {
    /// Number of its call.
    number: u64,
    others: Vec<Other>,
    /// Processes that have arrived and take part from the next agreement on.
    coming: Vec<Other>,
    /// Whether a process was lost.
    lost: bool,
    looked: Instant,
}

struct Other {
    link: Link,
    address: Address,
    /// Messages of the process that were not read yet.
    said: VecDeque<(Message, Vec<u8>)>,
}

/// The result of waiting for a message.
enum Waited {
    Said(Message, Vec<u8>),
    Lost,
    Stop,
}

fn failed(what: impl Into<String>) -> ModelError {
    ModelError::Group(what.into())
}

impl<'a> Members<'a> {
    /// Returns a process that listens at `host`, where others reach it, and takes part in the
    /// training with this key.
    ///
    /// # Errors
    /// [`ModelError::Group`] if it cannot listen there.
    pub fn new(
        rendezvous: &'a dyn Rendezvous,
        host: &str,
        training: &str,
        machine: &str,
        stopped: &'a dyn Fn() -> bool,
    ) -> Result<Self, ModelError> {
        let endpoint = Endpoint::open(host, training).map_err(|e| {
            failed(format!(
                "cannot listen at {host:?} for other processes of the training: {e}; give the worker an address of this \
                 machine"
            ))
        })?;
        let (hears, heard) = channel();
        Ok(Self {
            rendezvous,
            stopped,
            training: training.to_owned(),
            machine: machine.to_owned(),
            endpoint,
            breaker: Arc::default(),
            heard,
            hears,
            early: Vec::new(),
            role: Role::None,
            mesh: None,
            batches: 0,
            generation: 0,
            links: 0,
        })
    }

    /// Tells the others that the result is stored.
    pub fn over(&mut self) {
        self.greet();
        if let Role::Leads(leads) = &mut self.role {
            for other in leads.others.iter().chain(&leads.coming) {
                other.link.say(&Message::Over, &[]);
            }
        }
    }

    /// Joins the leading process, or becomes it.
    fn find(&mut self) -> Result<(), ModelError> {
        self.mesh = None;
        self.breaker.break_off();
        loop {
            let newest = self.rendezvous.newest();
            let newest = newest.map_err(failed)?;
            let number = newest.as_ref().map_or(0, |(number, _)| *number);
            let own = self.endpoint.address().clone();
            if let Some((_, call)) = newest.filter(|(_, call)| call.secret != own.secret) {
                let to = Address {
                    address: call.address.clone(),
                    secret: call.secret,
                };
                match visit(&to, &self.training, Wish::Join(own.clone())) {
                    Ok(stream) => {
                        let link = self.link(stream).map_err(|e| failed(e.to_string()))?;
                        info!(
                            "trains together with the process at {} ({})",
                            call.address, call.machine
                        );
                        self.role = Role::Follows { link, said: None };
                        return Ok(());
                    }
                    Err(error) if call.machine != self.machine => {
                        warn!(
                            %error,
                            "the process that leads this training is at {} on {}, which does not answer; this one leads from \
                             now on. If that one lives, start workers with an address at which others reach them",
                            call.address, call.machine
                        );
                    }
                    Err(error) => {
                        info!(%error, "the process that led this training does not answer; this one leads from now on");
                    }
                }
            }
            if (self.stopped)() {
                return Ok(());
            }
            let call = Call {
                address: own.address,
                secret: own.secret,
                machine: self.machine.clone(),
            };
            // This must happen before the call is made, so that no process that reads the call is
            // rejected.
            self.endpoint.lead(true);
            if self.rendezvous.make(number + 1, &call).map_err(failed)? {
                self.role = Role::Leads(Leads {
                    number: number + 1,
                    others: Vec::new(),
                    coming: Vec::new(),
                    lost: false,
                    looked: Instant::now(),
                });
                return Ok(());
            }
            self.endpoint.lead(false);
        }
    }

    fn link(&mut self, stream: TcpStream) -> io::Result<Link> {
        self.links += 1;
        Link::open(self.links, stream, self.hears.clone(), self.breaker.clone())
    }

    /// Handles newly arrived connections.
    fn greet(&mut self) {
        while let Some(arrived) = self.endpoint.arrived() {
            match arrived.wish {
                Wish::Add { generation, rank } => {
                    self.early.push((generation, rank, arrived.stream));
                }
                Wish::Join(address) => {
                    let Ok(link) = self.link(arrived.stream) else {
                        continue;
                    };
                    // A dropped connection makes the process ask again.
                    if let Role::Leads(leads) = &mut self.role
                        && leads.others.len() + leads.coming.len() + 1 < MOST
                    {
                        leads.coming.push(Other {
                            link,
                            address,
                            said: VecDeque::new(),
                        });
                    }
                }
            }
        }
        self.early
            .retain(|(generation, ..)| *generation >= self.generation);
    }

    /// On the leading process, records incoming messages.
    fn note(&mut self) {
        while let Ok((id, heard)) = self.heard.try_recv() {
            self.noted(id, heard);
        }
    }

    fn noted(&mut self, id: u64, heard: Heard) {
        let Role::Leads(leads) = &mut self.role else {
            return;
        };
        match heard {
            Heard::Lost => {
                let before = leads.others.len();
                leads.others.retain(|other| other.link.id != id);
                leads.coming.retain(|other| other.link.id != id);
                leads.lost |= leads.others.len() < before;
            }
            Heard::Said(message, payload) => {
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
    fn answer_of(&mut self, id: u64) -> Waited {
        loop {
            let Role::Leads(leads) = &mut self.role else {
                return Waited::Lost;
            };
            let Some(other) = leads.others.iter_mut().find(|other| other.link.id == id) else {
                return Waited::Lost;
            };
            if let Some((message, payload)) = other.said.pop_front() {
                return Waited::Said(message, payload);
            }
            match self.heard.recv_timeout(ASK) {
                Ok((from, heard)) => self.noted(from, heard),
                Err(RecvTimeoutError::Timeout) if (self.stopped)() => return Waited::Stop,
                Err(_) => {}
            }
        }
    }

    /// On another process, waits for a message of the leading one.
    fn said(&mut self) -> Waited {
        let Role::Follows { link, said } = &mut self.role else {
            return Waited::Lost;
        };
        if let Some((message, payload)) = said.take() {
            return Waited::Said(message, payload);
        }
        loop {
            match self.heard.recv_timeout(ASK) {
                Ok((id, _)) if id != link.id => {}
                Ok((_, Heard::Said(message, payload))) => return Waited::Said(message, payload),
                Ok((_, Heard::Lost)) => {
                    self.role = Role::None;
                    return Waited::Lost;
                }
                Err(RecvTimeoutError::Timeout) if (self.stopped)() => return Waited::Stop,
                Err(_) => {}
            }
        }
    }

    /// Stores a message of the leading process for [`Group::agree`].
    fn put_back(&mut self, message: Message, payload: Vec<u8>) {
        if let Role::Follows { said, .. } = &mut self.role {
            *said = Some((message, payload));
        }
    }

    /// Connects with all other processes.
    fn connect(&mut self, rank: usize, all: &[Address]) -> io::Result<Mesh> {
        let generation = self.generation;
        let mut peers: Vec<Option<TcpStream>> = all.iter().map(|_| None).collect();
        for (peer, address) in all.iter().enumerate().take(rank) {
            let wish = Wish::Add { generation, rank };
            peers[peer] = Some(visit(address, &self.training, wish)?);
        }
        let begun = Instant::now();
        while peers.iter().flatten().count() + 1 < all.len() {
            self.greet();
            let mut left = Vec::new();
            for (of, from, stream) in self.early.drain(..) {
                match of == generation && from > rank && from < all.len() && peers[from].is_none() {
                    true => peers[from] = Some(stream),
                    false => left.push((of, from, stream)),
                }
            }
            self.early = left;
            if begun.elapsed() > CONNECTED_WITHIN || (self.stopped)() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            if let Role::Follows { said: Some(_), .. } = &self.role {
                return Err(io::Error::other("another agreement"));
            }
            thread::sleep(Duration::from_millis(2));
        }
        Mesh::new(rank, peers, &self.breaker)
    }

    /// On the leading process, brings all members to the state of the most advanced one. Returns
    /// `None` if this must be repeated.
    fn gather(&mut self, member: &mut dyn Member) -> Result<Option<Next>, ModelError> {
        self.mesh = None;
        self.breaker.break_off();
        self.greet();
        self.note();
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
                match self.answer_of(id) {
                    Waited::Said(Message::Stands(at), _) => stand.push((id, at)),
                    // A message of the previous agreement.
                    Waited::Said(..) => continue,
                    Waited::Lost => {}
                    Waited::Stop => return Ok(Some(Next::Stop)),
                }
                break;
            }
        }
        let furthest = stand.iter().max_by_key(|(_, at)| *at);
        if let Some((id, at)) = furthest
            && *at > member.standing()
        {
            let state = match self.state_of(*id) {
                Waited::Said(_, state) => state,
                Waited::Lost => return Ok(None),
                Waited::Stop => return Ok(Some(Next::Stop)),
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

    fn state_of(&mut self, id: u64) -> Waited {
        let asked = self
            .other(id)
            .is_some_and(|other| other.link.say(&Message::SendState, &[]));
        if !asked {
            return Waited::Lost;
        }
        loop {
            match self.answer_of(id) {
                Waited::Said(Message::State, state) => return Waited::Said(Message::State, state),
                Waited::Said(..) => {}
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
                match self.answer_of(id) {
                    Waited::Said(Message::Formed { generation: of }, _) if of == generation => {
                        break;
                    }
                    Waited::Said(Message::Failed { generation: of }, _) if of == generation => {
                        return Ok(None);
                    }
                    Waited::Said(..) => {}
                    Waited::Lost => return Ok(None),
                    Waited::Stop => return Ok(Some(Next::Stop)),
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

    /// On another process, handles a message of the leading one. Returns `None` to wait for the
    /// next message.
    fn follow(&mut self, member: &mut dyn Member) -> Result<Option<Next>, ModelError> {
        let (message, payload) = match self.said() {
            Waited::Said(message, payload) => (message, payload),
            Waited::Lost => return Ok(None),
            Waited::Stop => return Ok(Some(Next::Stop)),
        };
        let answer = |role: &Role, message: Message, payload: &[u8]| {
            if let Role::Follows { link, .. } = role {
                link.say(&message, payload);
            }
        };
        match message {
            Message::Where => {
                self.mesh = None;
                answer(&self.role, Message::Stands(member.standing()), &[]);
            }
            Message::SendState => answer(&self.role, Message::State, &member.state()),
            Message::State => member.become_state(&payload)?,
            Message::Over => return Ok(Some(Next::Over)),
            Message::Form {
                generation,
                rank,
                members,
            } => {
                if rank == 0 || rank >= members.len() || members.len() > MOST {
                    return Err(failed("the leading process gave a rank that there is not"));
                }
                self.generation = generation;
                let n = members.len();
                match self.connect(rank, &members) {
                    Ok(mesh) => {
                        self.mesh = Some(mesh);
                        answer(&self.role, Message::Formed { generation }, &[]);
                        return Ok(Some(Next::Train {
                            share: share(self.batches, rank, n),
                            leads: false,
                        }));
                    }
                    Err(error) => {
                        info!(%error, "not connected with all processes of the training");
                        answer(&self.role, Message::Failed { generation }, &[]);
                    }
                }
            }
            // A message of a previous agreement.
            _ => {}
        }
        Ok(None)
    }
}

impl Group for Members<'_> {
    fn agree(&mut self, member: &mut dyn Member) -> Result<Next, ModelError> {
        self.batches = member.batches();
        loop {
            if (self.stopped)() {
                return Ok(Next::Stop);
            }
            let next = match &self.role {
                Role::None => {
                    self.find()?;
                    None
                }
                Role::Leads(_) => self.gather(member)?,
                Role::Follows { .. } => self.follow(member)?,
            };
            if let Some(next) = next {
                return Ok(next);
            }
        }
    }

    fn go_on(&mut self) -> Result<bool, ModelError> {
        if (self.stopped)() {
            return Ok(false);
        }
        match &self.role {
            Role::None => Ok(false),
            Role::Follows { .. } => match self.said() {
                Waited::Said(Message::Go, _) => Ok(true),
                Waited::Said(message, payload) => {
                    self.put_back(message, payload);
                    Ok(false)
                }
                Waited::Lost | Waited::Stop => Ok(false),
            },
            Role::Leads(_) => {
                self.greet();
                self.note();
                let Role::Leads(leads) = &mut self.role else {
                    return Ok(false);
                };
                if leads.lost || !leads.coming.is_empty() {
                    return Ok(false);
                }
                if leads.others.is_empty() {
                    let number = leads.number;
                    if leads.looked.elapsed() < LOOK {
                        return Ok(true);
                    }
                    leads.looked = Instant::now();
                    // If the place is unreachable now, it is tried again later.
                    return match self.superseded(number) {
                        Ok(superseded) => Ok(!superseded),
                        Err(_) => Ok(true),
                    };
                }
                Ok(leads
                    .others
                    .iter()
                    .all(|other| other.link.say(&Message::Go, &[])))
            }
        }
    }

    fn is_alone(&self) -> bool {
        self.mesh.as_ref().is_none_or(|mesh| mesh.len() == 1)
    }

    fn sum(&mut self, step: u64, compute: Compute<'_>) -> Result<Option<Vec<Part>>, ModelError> {
        let Some(mesh) = &self.mesh else {
            return Ok(None);
        };
        let (computed, sums) = mesh.sums(step, self.batches, compute, &self.breaker, self.stopped);
        match (computed, sums) {
            (Ok(()), Ok(whole)) => Ok(Some(whole)),
            (computed, sums) => {
                self.mesh = None;
                self.breaker.break_off();
                if let Err(error) = sums
                    && computed.is_ok()
                    && !(self.stopped)()
                {
                    info!(%error, step, "a step is not added up; the processes of the training agree anew");
                }
                let generation = self.generation;
                match &mut self.role {
                    Role::Follows { link, .. } => {
                        link.say(&Message::Failed { generation }, &[]);
                    }
                    Role::Leads(leads) => leads.lost = true,
                    Role::None => {}
                }
                computed.map(|()| None)
            }
        }
    }

    fn tell(&mut self, line: &Line, digest: u64) {
        if let Role::Leads(leads) = &self.role {
            let message = Message::Epoch {
                line: *line,
                digest,
            };
            for other in &leads.others {
                other.link.say(&message, &[]);
            }
        }
    }

    fn hear(&mut self, digest: u64) -> Result<Option<Line>, ModelError> {
        match self.said() {
            Waited::Said(
                Message::Epoch {
                    line,
                    digest: theirs,
                },
                _,
            ) if theirs == digest => Ok(Some(line)),
            Waited::Said(Message::Epoch { .. }, _) => Err(failed(
                "after an epoch this process has other numbers than the one that leads; processes of one training must \
                 compute alike: give them the same kind of device and the same program",
            )),
            Waited::Said(message, payload) => {
                self.put_back(message, payload);
                Ok(None)
            }
            Waited::Lost | Waited::Stop => Ok(None),
        }
    }
}
